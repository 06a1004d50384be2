// The weight and bias gradients of a K x K convolution for GPUs (K = KERNEL_SIZE), of the tiles of
// a list (tiles.h).
//
// A work-group sums a run of tiles for CI_QUADS x QUADS groups of 4 x 4 channels and all taps, a
// work-item one of them and one row of taps, in registers. STAGE tiles at a time come to local
// memory: the gradients of their pixels and the inputs that these saw.
#include "common.h"
#include "layers/local.h"

#ifndef CI_QUADS
#define CI_QUADS 4  // groups of 4 input channels of a work-group
#endif
#define ITEMS (CI_QUADS * QUADS * KERNEL_SIZE)
#define STAGE 2  // tiles in local memory

// Copy what the tiles [first, end) of the list saw of x, from channel c0 on, to values
// [tile][pixel][channel], and the gradients of their pixels, each as often as its tile counts, from
// channel o0 on, to grads. The gradients of tiles beyond are 0.
ALWAYS_INLINE void stage(
    local float4 *values,
    local float4 *grads,
    global const float *x,
    global const float *grad_out,
    global const int *tile_list,
    global const float *tile_count,
    const int first,
    const int end,
    const int c0,
    const int c,
    const int o0,
    const int co) {
    const int item = get_local_id(0), height = tile_list[0], width = tile_list[1];
    for (int i = item; i < STAGE * SPAN * SPAN * CI_QUADS; i += ITEMS) {
        const int quad = i % CI_QUADS, pixel = i / CI_QUADS % (SPAN * SPAN),
                  t = first + i / (CI_QUADS * SPAN * SPAN);
        const int2 at = tile_corner(tile_list[3 + min(t, end - 1)], width) +
                        (int2)(pixel % SPAN - PAD, pixel / SPAN - PAD);
        values[i] = pixel4(x, at.x, at.y, c0 + quad * 4, c, height, width);
    }
    for (int i = item; i < STAGE * MAP_TILE * MAP_TILE * QUADS; i += ITEMS) {
        const int quad = i % QUADS, pixel = i / QUADS % (MAP_TILE * MAP_TILE),
                  t = first + i / (QUADS * MAP_TILE * MAP_TILE),
                  tile = tile_list[3 + min(t, end - 1)];
        const int2 at = tile_corner(tile, width) + (int2)(pixel % MAP_TILE, pixel / MAP_TILE);
        grads[i] = t < end ? tile_count[tile] *
                                 pixel4(grad_out, at.x, at.y, o0 + quad * 4, co, height, width)
                           : (float4)(0.0f);
    }
}

// One work-item per (4 input channels, 4 output channels, ky), a work-group per (CI_QUADS, QUADS, 3
// of them, `run` tiles of the list): reads x and grad_out there, and writes its part of dL/dweight
// in rows (ky, kx, channel) of partial; those of the first input channels dL/dbias in the last row.
// A gradient counts as often as its tile.
kernel void conv_local_backward_weights(
    const int c1,
    const int c2,  // channels of x2; 0 = x2 is not read
    const int co,
    const int run,
    const int summed,                // tiles summed in registers
    global const float *x,           // (height, width, c1)
    global const float *x2,          // (height, width, ?)
    global const float *grad_out,    // (height, width, co)
    global const int *tile_list,     // (?) height, width, number, tiles
    global const float *tile_count,  // ((height+3)/4, (width+3)/4) of grad_out
    global float4 *partial)  // (?, (co+15)/16, KERNEL_SIZE*KERNEL_SIZE*(c1+c2)+1, 16) of each part
{
    local float4 values[STAGE * SPAN * SPAN * CI_QUADS];
    local float4 grads[STAGE * MAP_TILE * MAP_TILE * QUADS];
    const int item = get_local_id(0), lane = item % CI_QUADS, quad = item / CI_QUADS % QUADS,
              ky = item / (CI_QUADS * QUADS);
    const int group = get_global_id(0) / ITEMS, groups = (c1 + CI_QUADS * 4 - 1) / (CI_QUADS * 4);
    const bool second = group >= groups;  // of [x, x2], which is not made
    const int c = second ? c2 : c1, first = second ? c1 : 0, ci = c1 + c2;
    const int c0 = (second ? group - groups : group) * CI_QUADS * 4,
              o0 = get_group_id(1) * QUADS * 4, part = get_global_id(2);
    const int block = o0 / 16 + quad / 4, blocks = (co + 15) / 16;
    const int begin = part * run, end = min(begin + run, tile_list[2]);
    const bool with_bias = first + c0 == 0;  // of the work-group
    global float4 *of_block =
        partial + ((size_t)part * blocks + block) * (TAPS * ci + 1) * 4 + quad % 4;
    global float4 *out = of_block + (ky * KERNEL_SIZE * ci + first + c0 + lane * 4) * 4,
                  *bias = of_block + TAPS * ci * 4;
    for (int from = begin; from < end; from += summed) {
        float4 acc[KERNEL_SIZE][4], of_bias = 0.0f;
        UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
            UNROLLED_FOR (int i = 0; i < 4; i++)
                acc[kx][i] = 0.0f;
        const int to = min(from + summed, end);
        for (int t = from; t < to; t += STAGE) {
            barrier(CLK_LOCAL_MEM_FENCE);
            stage(
                values, grads, second ? x2 : x, grad_out, tile_list, tile_count, t, to, c0, c, o0,
                co);
            barrier(CLK_LOCAL_MEM_FENCE);
#pragma unroll 1
            for (int tile = 0; tile < STAGE; tile++)
#if KERNEL_SIZE == 3
#pragma unroll 1
#else
#pragma unroll 2
#endif
                for (int row = 0; row < MAP_TILE; row++) {
                    local const float4 *seen =
                        values + (tile * SPAN + row + ky) * SPAN * CI_QUADS + lane;
                    float4 g[MAP_TILE];
                    UNROLLED_FOR (int p = 0; p < MAP_TILE; p++)
                        g[p] = grads[((tile * MAP_TILE + row) * MAP_TILE + p) * QUADS + quad];
                    if (with_bias) of_bias += (g[0] + g[1]) + (g[2] + g[3]);
                    UNROLLED_FOR (int column = 0; column < SPAN; column++) {
                        const float4 v = seen[column * CI_QUADS];
                        UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++) {
                            const int p = column - kx;
                            if (p >= 0 && p < MAP_TILE) {
                                acc[kx][0] += v.x * g[p];
                                acc[kx][1] += v.y * g[p];
                                acc[kx][2] += v.z * g[p];
                                acc[kx][3] += v.w * g[p];
                            }
                        }
                    }
                }
        }
        UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
            UNROLLED_FOR (int i = 0; i < 4; i++) {
                global float4 *sum = out + (kx * ci + i) * 4;
                if (c0 + lane * 4 + i < c) *sum = from == begin ? acc[kx][i] : *sum + acc[kx][i];
            }
        if (with_bias && lane == 0 && ky == PAD) *bias = from == begin ? of_bias : *bias + of_bias;
    }
}
