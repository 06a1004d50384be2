// Winograd's convolutions on CPUs: tiles of 16 channels a vector, transformed in a slice of scratch
// memory for each compute unit.
#ifndef PP_WINOGRAD_H
#define PP_WINOGRAD_H
#include "layers/winograd_transforms.h"

#ifndef TILES
#define TILES 64  // tiles transformed and multiplied at a time
#endif
#ifndef HALF
// 1: transformed weights are stored as half (IEEE 754's 16 bits) and computed with as float
#define HALF 0
#endif

// Transformed weights are laid out (position, 16 output channels a block, input channel, 16). One
// vector more between two positions keeps these apart in the sets of a cache. With HALF they are
// multiples of their output channel's unit, a power of two (winograd_transform.cl), and the units
// of all blocks come first, float16 a block: as long as two vectors of weights.
#define WEIGHT_AT(position, block, blocks, channels)                                               \
    (2 * HALF * (blocks) + (position) * ((blocks) * (channels) + 1) + (block) * (channels))
#if HALF
#define LOAD_WEIGHT(transformed, at) vloada_half16(at, (global const half *)(transformed))
#define STORE_WEIGHT(value, transformed, at) vstorea_half16(value, at, (global half *)(transformed))
#else
#define LOAD_WEIGHT(transformed, at) (transformed)[at]
#define STORE_WEIGHT(value, transformed, at) (transformed)[at] = value
#endif

// Values of many tiles at once are laid out (position, 16 channels, TILES tiles); vectors from one
// position to the next. The odd one keeps the positions apart in the sets of a cache.
#define PITCH(channels) ((channels) / 16 * TILES + 1)

// A scratch begins with a vector for two counters, both 0 between kernels: how much of the work is
// taken, and how many work-items found nothing more to take. Which work-item takes what changes no
// result: a compute unit that is late or slow takes less.
#define COUNTERS 1

// The first of the next n pieces of work.
static inline int take(global float16 *scratch, const int n) {
    return atomic_add((volatile global int *)scratch, n);
}

// Called once by each work-item, after it took more than there is.
static inline void leave(global float16 *scratch) {
    volatile global int *counters = (volatile global int *)scratch;
    if (atomic_inc(counters + 1) == (int)get_global_size(0) - 1) {
        atomic_xchg(counters, 0);
        atomic_xchg(counters + 1, 0);
    }
}

// The `side` x `side` pixels from (x0, y0) on, 16 channels each, into rows of t that are S apart; 0
// outside the image. A tile across the border is gathered in `patch` first, so that one piece of
// straight code loads them all.
ALWAYS_INLINE void load_tile(
    float16 *t,
    const int side,             // S or M
    global float *patch,        // POSITIONS vectors
    global const float *image,  // at the first of the 16 channels
    const int channels,         // of a pixel
    const int x0,
    const int y0,
    const int height,
    const int width) {
    global const float *corner = image + ((long)y0 * width + x0) * channels;
    int row = width * channels, column = channels;
    if (x0 < 0 || y0 < 0 || x0 + side > width || y0 + side > height) {
        for (int i = 0; i < POSITIONS; i++) {
            const int x = x0 + i % WINO_S, y = y0 + i / WINO_S;
            float16 pixel = 0.0f;
            if (x >= 0 && x < width && y >= 0 && y < height)
                pixel = vload16(0, corner + i / WINO_S * row + i % WINO_S * column);
            vstore16(pixel, i, patch);
        }
        corner = patch;
        row = WINO_S * 16;
        column = 16;
    }
#pragma unroll
    for (int i = 0; i < POSITIONS; i++)
        if (i % WINO_S < side && i / WINO_S < side)
            t[i] = vload16(0, corner + i / WINO_S * row + i % WINO_S * column);
}

// v = B^T d B of the inputs d of `padded` tiles of tile_list from `first` on, 16 * chunks channels;
// the last of `count` is repeated.
ALWAYS_INLINE void transform_tiles(
    global float16 *v,
    const int pitch,
    global float *patch,    // POSITIONS vectors
    global const float *x,  // at the first of the channels
    const int channels,     // of a pixel
    const int chunks,
    global const int *tile_list,
    const int first,
    const int count,
    const int padded) {
    const int height = tile_list[0], width = tile_list[1];
    for (int tile = 0; tile < padded; tile++) {
        const int2 corner = tile_corner(tile_list, first + min(tile, count - 1)) - 1;
        for (int chunk = 0; chunk < chunks; chunk++) {
            float16 t[POSITIONS];
            load_tile(
                t, WINO_S, patch, x + chunk * 16, channels, corner.x, corner.y, height, width);
            transform_input_tile(t);
#pragma unroll
            for (int i = 0; i < POSITIONS; i++)
                v[i * pitch + chunk * TILES + tile] = t[i];
        }
    }
}

#endif
