// 3x3 convolution by Winograd's minimal filtering (winograd.h): what the forward pass (winograd.cl)
// and the gradient of its input (winograd_backward.cl) share.
//
// The image is cut into tiles of M x M outputs. A work-item takes those to compute, TILES or less
// at a time, through three stages: the input tiles are transformed, multiplied position by position
// as matrices (tiles x CI) (CI x CO), and transformed back. What lies between the stages stays in
// its own slice of `scratch`, small enough for the caches.
//
// One work-item per compute unit (work-groups of 1): an image's tiles are many, and each slice is
// used over and over.
#ifndef PP_WINOGRAD_CONVOLVE_H
#define PP_WINOGRAD_CONVOLVE_H

#include "layers/winograd.h"

#ifndef TILES
#define TILES 64  // tiles transformed and multiplied at a time
#endif

#ifndef BLOCKS
#define BLOCKS 2  // groups of 16 output channels multiplied together; divides their number
#endif
#ifndef TOGETHER
// tiles multiplied together: BLOCKS * TOGETHER accumulators and BLOCKS weights fit AVX-512
#define TOGETHER 8
#endif
// Vectors of a work-item's scratch: the values of ci channels, their products of co channels, a
// patch for load_tile.
#define SLICE(ci, co) (POSITIONS * (PITCH(ci, TILES) + PITCH(co, TILES) + 1))

// Stage 2: m (position, 16 of co, tile) = v (position, 16 of ci, tile) times the transformed
// weights.
ALWAYS_INLINE void multiply(
    global float16 *m,
    global const float16 *v,
    global const float16 *transformed,
    const int ci,
    const int blocks,
    const int padded) {
    for (int position = 0; position < POSITIONS; position++)
        for (int block = 0; block < blocks; block += BLOCKS)
            for (int tile = 0; tile < padded; tile += TOGETHER) {
                float16 acc[BLOCKS][TOGETHER];
                UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                    UNROLLED_FOR (int i = 0; i < TOGETHER; i++)
                        acc[b][i] = 0.0f;
                for (int chunk = 0; chunk < ci / 16; chunk++) {
                    global const float *value =
                        (global const float *)(v + position * PITCH(ci, TILES) + chunk * TILES +
                                               tile);
                    const int weight = WEIGHT_AT(position, block, blocks, ci) + chunk * 16;
#pragma unroll 4
                    for (int c = 0; c < 16; c++) {
                        float16 wc[BLOCKS];
                        UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                            wc[b] = transformed[weight + b * ci + c];
                        UNROLLED_FOR (int i = 0; i < TOGETHER; i++)
                            UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                                acc[b][i] += value[i * 16 + c] * wc[b];
                    }
                }
                UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                    UNROLLED_FOR (int i = 0; i < TOGETHER; i++)
                        m[position * PITCH(blocks * 16, TILES) + (block + b) * TILES + tile + i] =
                            acc[b][i];
            }
}

// Stage 3: the outputs of `count` tiles of tile_list from `first` on, co1 channels of them to out and
// co2 to out2, plus bias (0 = none); with relu, max(., 0) of them; with a mask of either, 0 where it
// is not positive.
ALWAYS_INLINE void transform_back(
    global float *out,
    global float *out2,
    global const float16 *m,
    global const float16 *bias,
    const int relu,
    global const float *mask,
    global const float *mask2,
    const int co1,
    const int co2,
    global const int *tile_list,
    const int first,
    const int count) {
    const int height = tile_list[0], width = tile_list[1], pitch = PITCH(co1 + co2, TILES);
    for (int tile = 0; tile < count; tile++) {
        const int2 corner = listed_corner(tile_list, first + tile);
        for (int block = 0; block < (co1 + co2) / 16; block++) {
            const bool second = block >= co1 / 16;
            const int channels = second ? co2 : co1, c0 = block * 16 - (second ? co1 : 0);
            global const float *masking = second ? mask2 : mask;
            global float *to = second ? out2 : out;
            float16 t[POSITIONS];
            UNROLLED_FOR (int i = 0; i < POSITIONS; i++)
                t[i] = m[i * pitch + block * TILES + tile];
            transform_output_tile(t);
            const float16 offset = bias ? bias[block] : (float16)0.0f;
            UNROLLED_FOR (int i = 0; i < WINO_M; i++)
                UNROLLED_FOR (int j = 0; j < WINO_M; j++)
                    if (corner.y + i < height && corner.x + j < width) {
                        const size_t at =
                            ((size_t)(corner.y + i) * width + corner.x + j) * channels + c0;
                        float16 value = t[i * WINO_S + j] + offset;
                        if (relu)  // max(., 0) would hide a NaN
                            value = select(value, (float16)0.0f, value < 0.0f);
                        if (masking)
                            value = select((float16)0.0f, value, vload16(0, masking + at) > 0.0f);
                        vstore16(value, 0, to + at);
                    }
        }
    }
}

// The whole convolution of [x, x2] (c2 = 0: of x) for the tiles that this work-item takes; bias,
// relu, mask, out: as in transform_back.
ALWAYS_INLINE void convolve(
    global const float *x,
    global const float *x2,
    const int c1,
    const int c2,
    global const float16 *transformed,
    global const float16 *bias,
    const int relu,
    global const float *mask,
    global const float *mask2,
    global float *out,
    global float *out2,
    const int co1,
    const int co2,
    global const int *tile_list,
    global float16 *scratch,  // all work-items'
    global float16 *v)        // the work-item's slice of it
{
    const int ci = c1 + c2, co = co1 + co2;
    global float16 *m = v + POSITIONS * PITCH(ci, TILES);
    global float *patch = (global float *)(m + POSITIONS * PITCH(co, TILES));

    const int tiles = tile_list[2];
    const int share = (tiles + get_global_size(0) - 1) / get_global_size(0);
    const int rounds = (share + TILES - 1) / TILES;  // of about the same size
    const int step = ((share + rounds - 1) / rounds + TOGETHER - 1) / TOGETHER * TOGETHER;
    for (int first = take(scratch, TILE_WORK, step); first < tiles;
         first = take(scratch, TILE_WORK, step)) {
        const int count = min(step, tiles - first),
                  padded = (count + TOGETHER - 1) / TOGETHER * TOGETHER;
        for (int source = 0; source < (c2 ? 2 : 1); source++)
            transform_tiles(
                v + (source ? c1 / 16 * TILES : 0), PITCH(ci, TILES), TILES, patch, source ? x2 : x,
                source ? c2 : c1, (source ? c2 : c1) / 16, tile_list, first, count, padded);
        multiply(m, v, transformed, ci, co / 16, padded);
        transform_back(out, out2, m, bias, relu, mask, mask2, co1, co2, tile_list, first, count);
    }
    leave(scratch);
}

#endif
