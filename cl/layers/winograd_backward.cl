// 3x3 convolution by Winograd's minimal filtering (winograd.h): the backward pass. One launch has the
// gradients of weights and inputs: a compute unit without a part of those begins with these.
//
// With inputs V = B^T d B and gradients Z = A g A^T of a tile, the gradient of the transformed
// weights is the sum of V o Z over all tiles: position by position a product of matrices (CI x
// tiles) (tiles x CO). The weights' own is G^T ... G of it.
#include "layers/winograd.h"

#ifndef SUM_TILES
#define SUM_TILES 32  // tiles transformed at a time for the weights
#endif
#ifndef SUM_BLOCKS
#define SUM_BLOCKS 2  // groups of 16 output channels multiplied together; divides their number
#endif
#ifndef CO_PART
#define CO_PART 128  // output channels taken at a time, a multiple of 16 * SUM_BLOCKS
#endif
// Vectors of one work-item's scratch: values, gradients, the sums of weights' and biases'
// gradients, a patch for load_tile.
#define SUM_SLICE(ci_part)                                                                         \
    (POSITIONS * (SUM_PITCH(ci_part) + SUM_PITCH(CO_PART) + (ci_part) * (CO_PART / 16) + 1) +      \
     CO_PART / 16)
#define SUM_PITCH(channels) PITCH(channels, SUM_TILES)
// tiles summed before their sum joins the rest: one sum over a large image would lose digits
#define SUMMED (32 * SUM_TILES)
// input channels multiplied together: ROWS * SUM_BLOCKS sums and SUM_BLOCKS vectors fit AVX-512
#define ROWS 8

// z = A g A^T of the gradients of `count` tiles of tile_list from `first` on, each times its
// tile_count; sums (16 channels each) += all of these gradients.
ALWAYS_INLINE void transform_gradients(
    global float16 *z,
    global float16 *sums,
    global float *patch,           // POSITIONS vectors
    global const float *grad_out,  // at the first of the channels
    const int channels,            // of a pixel
    const int blocks,
    global const int *tile_list,
    global const float *tile_count,
    const int first,
    const int count) {
    const int height = tile_list[0], width = tile_list[1];
    for (int block = 0; block < blocks; block++) {
        // summed apart: one sum over the whole image would lose digits
        float16 round = 0.0f;
        for (int tile = 0; tile < count; tile++) {
            const int2 corner = listed_corner(tile_list, first + tile);
            const float times = tile_count[tile_list[3 + first + tile]];
            float16 t[POSITIONS], sum = 0.0f;
            load_tile(
                t, WINO_M, patch, grad_out + block * 16, channels, corner.x, corner.y, height,
                width);
            UNROLLED_FOR (int i = 0; i < WINO_M; i++)
                UNROLLED_FOR (int j = 0; j < WINO_M; j++)
                    sum += t[i * WINO_S + j] *= times;
            round += sum;
            UNROLLED_FOR (int i = 0; i < WINO_M; i++)
                transform_gradient(t + i, WINO_S);
            UNROLLED_FOR (int i = 0; i < WINO_S; i++)
                transform_gradient(t + i * WINO_S, 1);
            UNROLLED_FOR (int i = 0; i < POSITIONS; i++)
                z[i * SUM_PITCH(CO_PART) + block * SUM_TILES + tile] = t[i];
        }
        sums[block] += round;
    }
}

// sums (position, 16 of co, ci) = or, after the first round, += v (position, 16 of ci, tile) times
// z (position, 16 of co, tile).
ALWAYS_INLINE void multiply_gradients(
    global float16 *sums,
    global const float16 *v,
    global const float16 *z,
    const int ci_part,
    const int rows,
    const int blocks,
    const int count,
    const int first_round) {
    for (int position = 0; position < POSITIONS; position++)
        for (int block = 0; block < blocks; block += SUM_BLOCKS)
            for (int row = 0; row < rows; row += ROWS) {
                float16 acc[SUM_BLOCKS][ROWS];
                UNROLLED_FOR (int b = 0; b < SUM_BLOCKS; b++)
                    UNROLLED_FOR (int i = 0; i < ROWS; i++)
                        acc[b][i] = 0.0f;
                global const float16 *grad = z + position * SUM_PITCH(CO_PART) + block * SUM_TILES;
                global const float *value =
                    (global const float *)(v + position * SUM_PITCH(ci_part) +
                                           row / 16 * SUM_TILES);
#pragma unroll 4
                for (int tile = 0; tile < count; tile++) {
                    float16 g[SUM_BLOCKS];
                    UNROLLED_FOR (int b = 0; b < SUM_BLOCKS; b++)
                        g[b] = grad[b * SUM_TILES + tile];
                    UNROLLED_FOR (int i = 0; i < ROWS; i++)
                        UNROLLED_FOR (int b = 0; b < SUM_BLOCKS; b++)
                            acc[b][i] += value[tile * 16 + row % 16 + i] * g[b];
                }
                global float16 *sum = sums + (position * (CO_PART / 16) + block) * ci_part + row;
                UNROLLED_FOR (int b = 0; b < SUM_BLOCKS; b++)
                    UNROLLED_FOR (int i = 0; i < ROWS; i++)
                        sum[b * ci_part + i] =
                            first_round ? acc[b][i] : sum[b * ci_part + i] + acc[b][i];
            }
}

// Gradients of 3 x 3 weights of `rows` input channels and 16 output channels from those of their
// transforms: written with first_sum, else added.
ALWAYS_INLINE void store_gradients(
    global float16 *grad_weight,
    global const float16 *sums,
    const int ci,
    const int ci_part,
    const int rows,
    const int first_sum) {
    for (int row = 0; row < rows; row++) {
        float16 t[POSITIONS];
        UNROLLED_FOR (int i = 0; i < POSITIONS; i++)
            t[i] = sums[i * (CO_PART / 16) * ci_part + row];
        UNROLLED_FOR (int i = 0; i < WINO_S; i++)
            transform_kernel_gradient(t + i, WINO_S);
        UNROLLED_FOR (int i = 0; i < 3; i++)
            transform_kernel_gradient(t + i * WINO_S, 1);
        UNROLLED_FOR (int i = 0; i < 9; i++)
            grad_weight[i * ci + row] = first_sum
                                            ? t[i / 3 * WINO_S + i % 3]
                                            : grad_weight[i * ci + row] + t[i / 3 * WINO_S + i % 3];
    }
}

// One work-item per compute unit: takes parts of the weights' gradients, of ci_part x CO_PART
// channels and one of tile_parts stretches of tile_list: walks those tiles in [x, x2] (without
// making it) and grad_out, writes its part of the sums: dL/dweight in rows (ky, kx, channel) of
// partial, dL/dbias in the last row. Then takes tiles of grad_list, reads their neighbourhood in
// grad_out, writes those tiles of grad_x and grad_x2: the convolution of grad_out with the flipped
// weights. masked: as in conv_backward.cl.
kernel void winograd_backward(
    const int c1,
    const int c2,  // channels of x2; 0 = x2 is not read
    const int co,
    const int masked,
    const int ci_part,               // a multiple of 16
    const int tile_parts,            // at most the number of tiles
    global const float *x,           // (height, width, c1)
    global const float *x2,          // (height, width, ?)
    global const float16 *flipped,   // (36*(c1*co+c2*co+16)) transformed, as winograd.h says
    global const float *grad_out,    // (height, width, co)
    global const int *tile_list,     // (?) of grad_out
    global const float *tile_count,  // ((height+3)/4, (width+3)/4) of grad_out
    global const int *grad_list,     // (?) of grad_x and grad_x2
    global float16 *partial,         // (?, co/16, 9*(c1+c2)+1, 16) of each of tile_parts
    global float *grad_x,            // (height, width, c1)
    global float *grad_x2,           // (height, width, ?)
    global float16 *scratch)         // (...) COUNTERS + work-items * the larger SLICE
{
    const int tiles = tile_list[2], ci = c1 + c2;
    const int co_parts = (co + CO_PART - 1) / CO_PART,
              weight_parts = (ci + ci_part - 1) / ci_part * co_parts;
    global float16 *v =
        scratch + COUNTERS + (size_t)get_global_id(0) * max(SUM_SLICE(ci_part), SLICE(co, ci));
    global float16 *z = v + POSITIONS * SUM_PITCH(ci_part),
                   *sums = z + POSITIONS * SUM_PITCH(CO_PART);
    global float16 *bias = sums + POSITIONS * ci_part * (CO_PART / 16);
    global float *patch = (global float *)(bias + CO_PART / 16);
    const int parts = weight_parts * tile_parts;
    for (int part; (part = take(scratch, 1, 1)) < parts;) {
        const int tile_part = part / weight_parts, weight_part = part % weight_parts;
        const int c0 = weight_part / co_parts * ci_part, rows = min(ci_part, ci - c0);
        const int rows_of_x = clamp(c1 - c0, 0, rows);
        const int block0 = weight_part % co_parts * (CO_PART / 16),
                  blocks = min(CO_PART / 16, co / 16 - block0);
        const int first = (long)tiles * tile_part / tile_parts,
                  end = (long)tiles * (tile_part + 1) / tile_parts;
        global float16 *out = partial + ((size_t)tile_part * (co / 16) + block0) * (9 * ci + 1);
        for (int begin = first; begin < end; begin += SUMMED) {
            for (int block = 0; block < blocks; block++)
                bias[block] = 0.0f;
            for (int tile = begin; tile < min(begin + SUMMED, end); tile += SUM_TILES) {
                const int count = min(SUM_TILES, end - tile);
                for (int source = 0; source < (c2 ? 2 : 1); source++)
                    transform_tiles(
                        v + (source ? rows_of_x / 16 * SUM_TILES : 0), SUM_PITCH(ci_part),
                        SUM_TILES, patch, source ? x2 + max(c0 - c1, 0) : x + c0, source ? c2 : c1,
                        (source ? rows - rows_of_x : rows_of_x) / 16, tile_list, tile, count,
                        count);
                transform_gradients(
                    z, bias, patch, grad_out + block0 * 16, co, blocks, tile_list, tile_count, tile,
                    count);
                multiply_gradients(sums, v, z, ci_part, rows, blocks, count, tile == begin);
            }
            for (int block = 0; block < blocks; block++) {
                global float16 *weight = out + block * (9 * ci + 1);
                store_gradients(
                    weight + c0, sums + block * ci_part, ci, ci_part, rows, begin == first);
                if (c0 == 0)
                    weight[9 * ci] = begin == first ? bias[block] : weight[9 * ci] + bias[block];
            }
        }
    }
    convolve(
        grad_out, 0, co, 0, flipped, 0, 0, masked & 1 ? x : 0, masked & 2 ? x2 : 0, grad_x, grad_x2,
        c1, c2, grad_list, scratch, v);
}
