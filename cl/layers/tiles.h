// A feature map cut into tiles of SIDE x SIDE pixels, numbered row by row, and the list of those
// that a kernel computes (pp_cl/engine/layers/tiles.py).
#ifndef PP_TILES_H
#define PP_TILES_H

#define SIDE 4

static inline int tile_columns(const int width) {
    return (width + SIDE - 1) / SIDE;
}

// The first pixel of a tile.
static inline int2 tile_corner(const int tile, const int width) {
    const int columns = tile_columns(width);
    return (int2)(tile % columns, tile / columns) * SIDE;
}

// Whether the tile of pixel (x, y) is computed; tile_count: see pp_cl/engine/layers/tiles.py.
static inline bool
tile_is_computed(global const float *tile_count, const int x, const int y, const int width) {
    return tile_count[y / SIDE * tile_columns(width) + x / SIDE] > 0.0f;
}

#endif
