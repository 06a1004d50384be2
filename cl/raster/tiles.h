// Tiles: parts of an image of 4 x 4 blocks of 4 x 4 samples each, which is 16 x 16 pixels of one
// sample or 8 x 8 of four. A tile has one list of the points that may cover its samples, nearest
// first, since the depth of a point is the same in all of them. What a sample needs on a walk along
// the list stays in registers and in the cache, and falloffs are computed anew on each walk: nothing
// is stored by fragment.
//
// On CPUs one work-item walks for a tile, with the samples of a block in the lanes of its vectors.
// On GPUs GROUP work-items do, each with the samples of one pixel of some blocks (gpu/tiles.h).
#ifndef PP_RASTER_TILES_H
#define PP_RASTER_TILES_H

#include "common.h"
#include "camera.h"
#include "group.h"
#include "lanes.h"
#include "raster/footprint.h"
#include "reduce.h"

#define BLOCKS 16  // of a tile
#define TILE_SAMPLES (16 * BLOCKS)
#define BLOCK_SIDE (4 / SUPERSAMPLING)  // pixels
// Pixels of a block; sample s of pixel k is in lane BLOCK_PIXELS s + k.
#define BLOCK_PIXELS (16 / SAMPLES)
// Parts of 4 x 4 pixels, which are the network's tiles (layers/tiles.h), along a tile.
#define COVERED (4 / SUPERSAMPLING)

// The first pixel of a block in its tile. In their Z-order, four neighbours follow one another.
#define BLOCK_X(b) (BLOCK_SIDE * (int)(((b) & 1) | ((b) >> 1 & 2)))
#define BLOCK_Y(b) (BLOCK_SIDE * (int)(((b) >> 1 & 1) | ((b) >> 2 & 2)))

// Bits of the blocks in the first n columns and rows.
constant uint COLUMNS[5] = {0, 0x0505, 0x0f0f, 0x5f5f, 0xffff};
constant uint ROWS[5] = {0, 0x0033, 0x00ff, 0x33ff, 0xffff};

typedef struct {
    Camera cam;
    int width, height;  // pixels of the image
    int x, y;           // the tile's first pixel
    uint number;
} Tile;

ALWAYS_INLINE Tile tile_load(global const float *camera, const uint number) {
    Tile tile;
    tile.cam = camera_load(camera);
    tile.width = tile.cam.width / SUPERSAMPLING;
    tile.height = tile.cam.height / SUPERSAMPLING;
    const uint columns = (tile.width + TILE_SIDE - 1) / TILE_SIDE;
    tile.x = number % columns * TILE_SIDE;
    tile.y = number / columns * TILE_SIDE;
    tile.number = number;
    return tile;
}

// Bits of the tile's blocks that a point's box touches.
ALWAYS_INLINE uint blocks_of(const Point *p, const Tile *tile) {
    const int2 corner = (int2)(tile->x, tile->y);
    const int2 first = max(as_int2(p->first) - corner, (int2)(0)) / BLOCK_SIDE;
    const int2 last = min(as_int2(p->last) - corner, (int2)(TILE_SIDE - 1)) / BLOCK_SIDE;
    return COLUMNS[last.x + 1] & ~COLUMNS[first.x] & ROWS[last.y + 1] & ~ROWS[first.y];
}

// The pair of a point and a tile: a point's pairs follow one another from `offset` on, row by row.
ALWAYS_INLINE uint pair_of(const Point *p, const Tile *tile, const uint offset) {
    const uint2 first = p->first / TILE_SIDE, last = p->last / TILE_SIDE;
    const uint row = tile->y / TILE_SIDE - first.y, column = tile->x / TILE_SIDE - first.x;
    return offset + row * (last.x - first.x + 1) + column;
}

// Values of samples are kept by tile, by block and by lane.
#define SAMPLE_ROW(tile, own) ((size_t)(tile)->number * BLOCKS + BLOCK(own))

#if GROUP > 1
#include "gpu/tiles.h"
#else

// A work-item's blocks, and those of them of which `bits` has a bit.
#define OWN_BLOCKS BLOCKS
#define BLOCK(own) (own)
#define FOR_BLOCKS(own, bits)                                                                      \
    for (uint left = (bits), own; left && ((own = 31 - clz(left & -left)), true); left &= left - 1)

// Which of a block's samples a work-item has, and their values, of type `floats` or `ints`.
#define SAMPLE LANE
#define SAMPLE_VALUES(type, array, row) ((global type *)(array))[row]

// The pixels of a block that a work-item writes, and where sum_pixels() put their sums.
#define FOR_PIXELS(k) for (int k = 0; k < BLOCK_PIXELS; k++)
#define OF_PIXEL(k) k
#define OWN_PIXELS BLOCK_PIXELS

// GPUs read a list in batches, into local memory.
#define BATCH(left) (left)
#define SHARED_LIST
#define READ_BATCH(entry)
#define ENTRY(entry) entry
#define POINT(entry) POINT_OF(point_record, (uint)(entry))
#define SHARED_FEATURES
#define READ_FEATURES
#define FEATURES(entry) visible_features[point_slot[(uint)(entry)]]

// Whether any work-item's value is not 0, and whether a walk needs no more pairs of a batch.
#define ANY_MEMBER(value) ((value) != 0)
#define IS_DONE(live) ((live) == 0)

// any() of PoCL 3.1 takes vectors apart.
#ifdef POCL_DEVICE_ADDRESS_BITS
ALWAYS_INLINE bool any_sample(const int16 v) {
    const long8 wide = as_long8(v);
    const long4 half_ = wide.lo | wide.hi;
    const long2 quarter = half_.lo | half_.hi;
    return (quarter.x | quarter.y) != 0;
}
#else
#define any_sample any
#endif

// The sums over the samples of each pixel of a block.
ALWAYS_INLINE void sum_pixels(const float16 v, float sums[OWN_PIXELS]) {
#if SAMPLES == 4
    const float8 halves = v.lo + v.hi;
    vstore4(halves.lo + halves.hi, 0, sums);
#else
    vstore16(v, 0, sums);
#endif
}

// The least of the samples of each pixel of a block, in all of them; NaN only where all are.
ALWAYS_INLINE float16 least_of_pixels(const float16 v) {
#if SAMPLES == 4
    const float8 halves = fmin(v.lo, v.hi);
    const float4 least = fmin(halves.lo, halves.hi);
    return (float16)(least, least, least, least);
#else
    return v;
#endif
}

// Adds features f by the weights b of a block's samples to the sums of its pixels.
ALWAYS_INLINE void add_features(float16 *sums, const float16 b, const float16 f) {
    float weights[BLOCK_PIXELS];
    sum_pixels(b, weights);
    UNROLLED_FOR (int k = 0; k < BLOCK_PIXELS; k++)
        sums[k] += weights[k] * f;
}
#endif

// Points and features that a walk reads soon.
#define PAIRS_AHEAD 10
#define FEATURES_AHEAD 6
#define READ_POINT_AHEAD(entry) READ_AHEAD(point_record + RECORD * (size_t)(uint)(entry));
#define READ_FEATURES_AHEAD(entry, sooner)                                                         \
    READ_AHEAD(point_slot + (uint)(entry));                                                        \
    READ_AHEAD(visible_features + point_slot[(uint)(sooner)]);

// The samples' places in a tile, and the rays through them; returns the blocks with any sample in
// the image.
ALWAYS_INLINE uint tile_rays(const Tile *tile, Rays rays[OWN_BLOCKS], ints inside[OWN_BLOCKS]) {
    const Camera *cam = &tile->cam;
    const float per_fx = reciprocal(cam->fx), per_fy = reciprocal(cam->fy);
    const uints pixel = SAMPLE % BLOCK_PIXELS, sample = SAMPLE / BLOCK_PIXELS;
    const ints x = LANED(convert_int)(pixel % BLOCK_SIDE),
               y = LANED(convert_int)(pixel / BLOCK_SIDE);
    const floats dx =
        LANED(convert_float)(SUPERSAMPLING * x + LANED(convert_int)(sample % SUPERSAMPLING));
    const floats dy =
        LANED(convert_float)(SUPERSAMPLING * y + LANED(convert_int)(sample / SUPERSAMPLING));
    uint blocks = 0;
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        const int x0 = tile->x + BLOCK_X(BLOCK(own)), y0 = tile->y + BLOCK_Y(BLOCK(own));
        inside[own] = x0 + x < tile->width & y0 + y < tile->height;
        if (any_sample(inside[own])) blocks |= 1u << BLOCK(own);
        Rays *m = rays + own;
        m->x = (dx + (float)(SUPERSAMPLING * x0) + (0.5f - cam->cx)) * per_fx;
        m->y = (dy + (float)(SUPERSAMPLING * y0) + (0.5f - cam->cy)) * per_fy;
        m->length2 = FMA(m->x, m->x, FMA(m->y, m->y, 1.0f));
        m->per_length = 1.0f / sqrt(m->length2);
#if FOOTPRINT == GAUSSIAN
        m->column = dx + (x0 + 0.5f);
        m->row = dy + (y0 + 0.5f);
#endif
    }
    return blocks;
}

// The number of pixel k of a block in the image, or NONE; pixel_of() of one of a work-item's blocks.
ALWAYS_INLINE uint pixel_in(const Tile *tile, const uint block, const int k) {
    const int x = tile->x + BLOCK_X(block) + k % BLOCK_SIDE;
    const int y = tile->y + BLOCK_Y(block) + k / BLOCK_SIDE;
    return x < tile->width && y < tile->height ? y * tile->width + x : NONE;
}
#define pixel_of(tile, own, k) pixel_in(tile, BLOCK(own), k)

#endif
