// 3x3 convolution by Winograd's minimal filtering (winograd.h): the forward pass and the gradient
// of its input.
//
// The image is cut into tiles of M x M outputs. A work-item takes those to compute, TILES or less
// at a time, through three stages: the input tiles are transformed, multiplied position by position
// as matrices (tiles x CI) (CI x CO), and transformed back. What lies between the stages stays in
// its own slice of `scratch`, small enough for the caches.
//
// One work-item per compute unit (work-groups of 1): an image's tiles are many, and each slice is
// used over and over.
#include "layers/winograd.h"

#ifndef BLOCKS
#define BLOCKS 2  // groups of 16 output channels multiplied together; divides their number
#endif
#ifndef TOGETHER
// tiles multiplied together: BLOCKS * TOGETHER accumulators and BLOCKS weights fit AVX-512
#define TOGETHER 8
#endif
// Vectors of a work-item's scratch: the values of ci channels, their products of co channels, a
// patch for load_tile.
#define SLICE(ci, co) (POSITIONS * (PITCH(ci) + PITCH(co) + 1))

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
                        (global const float *)(v + position * PITCH(ci) + chunk * TILES + tile);
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
                        m[position * PITCH(blocks * 16) + (block + b) * TILES + tile + i] =
                            acc[b][i];
            }
}

// Stage 3: the outputs of `count` tiles of tile_list from `first` on, plus bias (0 = none); with
// relu, max(., 0) of them; with mask, 0 where mask is not positive.
ALWAYS_INLINE void transform_back(
    global float *out,
    global const float16 *m,
    global const float16 *bias,
    const int relu,
    global const float *mask,
    const int co,
    global const int *tile_list,
    const int first,
    const int count) {
    const int height = tile_list[0], width = tile_list[1], pitch = PITCH(co);
    for (int tile = 0; tile < count; tile++) {
        const int2 corner = listed_corner(tile_list, first + tile);
        for (int block = 0; block < co / 16; block++) {
            float16 t[POSITIONS];
            UNROLLED_FOR (int i = 0; i < POSITIONS; i++)
                t[i] = m[i * pitch + block * TILES + tile];
            transform_output_tile(t);
            const float16 offset = bias ? bias[block] : (float16)0.0f;
            UNROLLED_FOR (int i = 0; i < WINO_M; i++)
                UNROLLED_FOR (int j = 0; j < WINO_M; j++)
                    if (corner.y + i < height && corner.x + j < width) {
                        const size_t at =
                            ((size_t)(corner.y + i) * width + corner.x + j) * co + block * 16;
                        float16 value = t[i * WINO_S + j] + offset;
                        if (relu)  // max(., 0) would hide a NaN
                            value = select(value, (float16)0.0f, value < 0.0f);
                        if (mask)
                            value = select((float16)0.0f, value, vload16(0, mask + at) > 0.0f);
                        vstore16(value, 0, out + at);
                    }
        }
    }
}

// The whole convolution of [x, x2] (c2 = 0: of x) for the tiles that this work-item takes; bias,
// relu, mask: as in transform_back.
ALWAYS_INLINE void convolve(
    global const float *x,
    global const float *x2,
    const int c1,
    const int c2,
    global const float16 *transformed,
    global const float16 *bias,
    const int relu,
    global const float *mask,
    global float *out,
    const int co,
    global const int *tile_list,
    global float16 *scratch)  // all work-items'
{
    const int ci = c1 + c2;
    global float16 *v = scratch + COUNTERS + get_global_id(0) * SLICE(ci, co);
    global float16 *m = v + POSITIONS * PITCH(ci);
    global float *patch = (global float *)(m + POSITIONS * PITCH(co));

    const int tiles = tile_list[2];
    const int share = (tiles + get_global_size(0) - 1) / get_global_size(0);
    const int rounds = (share + TILES - 1) / TILES;  // of about the same size
    const int step = ((share + rounds - 1) / rounds + TOGETHER - 1) / TOGETHER * TOGETHER;
    for (int first = take(scratch, step); first < tiles; first = take(scratch, step)) {
        const int count = min(step, tiles - first),
                  padded = (count + TOGETHER - 1) / TOGETHER * TOGETHER;
        for (int source = 0; source < (c2 ? 2 : 1); source++)
            transform_tiles(
                v + (source ? c1 / 16 * TILES : 0), PITCH(ci), patch, source ? x2 : x,
                source ? c2 : c1, (source ? c2 : c1) / 16, tile_list, first, count, padded);
        multiply(m, v, transformed, ci, co / 16, padded);
        transform_back(out, m, bias, relu, mask, co, tile_list, first, count);
    }
    leave(scratch);
}

// One work-item per compute unit: takes tiles, reads their neighbourhood in x, then in x2 (the
// concatenation [x, x2] without making it), and writes those tiles of out.
kernel void winograd_forward(
    const int c1,
    const int c2,  // channels of x2; 0 = x2 is not read
    const int co,
    const int relu,                // negative results become 0
    global const float *x,         // (height, width, c1)
    global const float *x2,        // (height, width, ?)
    global const float16 *weight,  // (36*(c1*co+c2*co+16)) transformed, as winograd.h says
    global const float16 *bias,    // (co)
    global const int *tile_list,   // (?)
    global float *out,             // (height, width, co)
    global float16 *scratch)       // (...) COUNTERS + work-items * SLICE(c1 + c2, co)
{
    convolve(x, x2, c1, c2, weight, bias, relu, 0, out, co, tile_list, scratch);
}

// One work-item per compute unit: takes tiles, reads their neighbourhood in grad_out, and writes
// those tiles of grad_x, which is the convolution of grad_out with the flipped weights. masked: x
// is the output of a ReLU and grad_x the gradient of its input.
kernel void winograd_backward_input(
    const int c,
    const int co,
    const int masked,
    global const float *x,          // (height, width, c)
    global const float16 *flipped,  // (36*(c*co+16)) transformed, as winograd.h says
    global const float *grad_out,   // (height, width, co)
    global const int *tile_list,    // (?) of grad_x
    global float *grad_x,           // (height, width, c)
    global float16 *scratch)        // (...) COUNTERS + work-items * SLICE(co, c)
{
    convolve(grad_out, 0, co, 0, flipped, 0, 0, masked ? x : 0, grad_x, c, tile_list, scratch);
}
