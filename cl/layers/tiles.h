// A feature map cut into tiles of MAP_TILE x MAP_TILE pixels, numbered row by row, and the list of those
// that a kernel computes (pp_cl/engine/layers/tiles.py).
#ifndef PP_TILES_H
#define PP_TILES_H

#define MAP_TILE 4

static inline int tile_columns(const int width) {
    return (width + MAP_TILE - 1) / MAP_TILE;
}

// The first pixel of a tile.
static inline int2 tile_corner(const int tile, const int width) {
    const int columns = tile_columns(width);
    return (int2)(tile % columns, tile / columns) * MAP_TILE;
}

// Whether the tile of pixel (x, y) is computed; tile_count: see pp_cl/engine/layers/tiles.py.
static inline bool
tile_is_computed(global const float *tile_count, const int x, const int y, const int width) {
    return tile_count[y / MAP_TILE * tile_columns(width) + x / MAP_TILE] > 0.0f;
}

#endif
