// Tiles of a feature map (tiles.h): which ones are not background, and copying one to another.
#include "lanes.h"
#include "layers/tiles.h"

// One work-item per tile: reads its pixels, writes 1 if any channel of any is not `background`, a
// NaN included, else 0.
kernel void tiles_find(
    const int h,
    const int w,
    const int c,
    const float background,
    global const float *x,  // (h, w, c)
    global int *flags)      // (?, ?) tiles
{
    const int tile = get_global_id(0), columns = tile_columns(w), rows = tile_columns(h);
    if (tile >= columns * rows) return;
    const int x0 = tile % columns * MAP_TILE, y0 = tile / columns * MAP_TILE;
    const int values = min(MAP_TILE, w - x0) * c;  // of one line of the tile
    int other = 0;
    for (int y = y0; y < min(y0 + MAP_TILE, h); y++) {
        global const float *line = x + ((size_t)y * w + x0) * c;
        for (int i = 0; i < values; i++)
            other |= line[i] != background;
    }
    flags[tile] = other;
}

// One work-item per (LANES channels, pixel of a tile, copy): writes the pixel of the tile `to` as
// it is in the tile `from`. Both have the same shape, and nothing is copied to `from`.
kernel void tiles_copy(
    const int h,
    const int w,
    const int c,
    const int n,                 // copies
    global const int2 *from_to,  // (?, 2) tiles: from, to
    global float *x)             // (h, w, c)
{
    const int first = get_global_id(0) * LANES, pixel = get_global_id(1), i = get_global_id(2),
              columns = tile_columns(w);
    if (first >= c || pixel >= MAP_TILE * MAP_TILE || i >= n) return;
    const int from = from_to[i].x, to = from_to[i].y;
    const int column = to % columns * MAP_TILE + pixel % MAP_TILE,
              row = to / columns * MAP_TILE + pixel / MAP_TILE;
    if (column >= w || row >= h) return;
    const size_t read = (size_t)(from / columns * MAP_TILE + pixel / MAP_TILE) * w +
                        from % columns * MAP_TILE + pixel % MAP_TILE;
    store_lanes(
        load_lanes(x + read * c + first, c - first), x + ((size_t)row * w + column) * c + first,
        c - first);
}
