// 3x3 convolution by Winograd's minimal filtering (winograd_transforms.h) for GPUs, of the tiles of
// a list (tiles.h): the forward pass and the gradient of its input.
//
// `count` tiles of M x M outputs at a time pass through three kernels: their inputs are
// transformed, multiplied position by position as matrices (count x CI) (CI x CO), and transformed
// back. What lies between the kernels stays in the device's last cache. A product's sum runs over
// the channels in order, whatever the list is: the same bits with all tiles and with some.
#define VALUE float
#include "layers/winograd_transforms.h"

#ifndef QUADS
#define QUADS 4  // groups of 4 output channels of a work-group: 4, 8 or 16
#endif
#ifndef ITEMS
#define ITEMS 128  // of a work-group, at least QUADS / 2
#endif
// A work-item of the multiplication sums 8 tiles times 8 channels in registers: fours apart by half
// of what the work-group computes, so that neighbours read neighbouring fours of local memory.
#define COLUMNS (QUADS / 2)
#define ROWS (ITEMS / COLUMNS)
#define GROUP_TILES (8 * ROWS)
#define CHUNK 8                  // input channels at a time in local memory
#define PITCH (GROUP_TILES + 4)  // the two fours of a tile's channels lie in different banks

// A scratch begins with counters that only winograd.h knows; then come the transformed inputs
// (POSITIONS, count, ci) and their products (POSITIONS, count, co).
#define COUNTERS 16

// One work-item per (16 output channels and which of them, input channel): reads 3 x 3 weights,
// writes their values at all positions. flipped: the roles of input and output channels are
// exchanged and the kernels mirrored, for the gradient of the input channels from `first` on.
kernel void winograd_gemm_weights(
    const int ci,  // input channels of the convolution
    const int co,
    const int flipped,
    const int first,
    const int channels,          // of weight
    global const float *weight,  // (?, 3, 3, channels, 16)
    global float *transformed)   // (...) at least POSITIONS * ci * co: position, ci, co
{
    const int o = get_global_id(0), c = get_global_id(1);
    if (o >= co || c >= ci) return;
    const int out = flipped ? c : o, in = flipped ? first + o : c;
    global const float *w = weight + (out / 16 * 9 * channels + in) * 16 + out % 16;
    float t[POSITIONS];
#pragma unroll
    for (int i = 0; i < 9; i++)
        t[i / 3 * WINO_S + i % 3] = w[(flipped ? 8 - i : i) * channels * 16];
    transform_kernel_tile(t);
#pragma unroll
    for (int i = 0; i < POSITIONS; i++)
        transformed[(i * ci + c) * co + o] = t[i];
}

// One work-item per (channel of [x, x2], tile of the list from `first` on): reads what the tile
// sees, 0 outside of the image, and writes its values at all positions.
kernel void winograd_gemm_inputs(
    const int c1,
    const int c2,  // channels of x2; 0 = x2 is not read
    const int first,
    const int count,
    global const float *x,        // (height, width, c1)
    global const float *x2,       // (height, width, ?)
    global const int *tile_list,  // (?) height, width, number, tiles
    global float *scratch)        // (...)
{
    const int c = get_global_id(0), tile = get_global_id(1), ci = c1 + c2;
    if (c >= ci || tile >= count) return;
    const int height = tile_list[0], width = tile_list[1], channels = c < c1 ? c1 : c2;
    const int2 corner = tile_corner(tile_list, first + tile) - 1;
    global const float *image = c < c1 ? x + c : x2 + c - c1;
    float t[POSITIONS];
#pragma unroll
    for (int i = 0; i < POSITIONS; i++) {
        const int px = corner.x + i % WINO_S, py = corner.y + i / WINO_S;
        const bool inside = px >= 0 && px < width && py >= 0 && py < height;
        t[i] = inside ? image[((size_t)py * width + px) * channels] : 0.0f;
    }
    transform_input_tile(t);
#pragma unroll
    for (int i = 0; i < POSITIONS; i++)
        scratch[COUNTERS + (i * count + tile) * ci + c] = t[i];
}

// One work-item per (8 tiles, 8 output channels, position), a work-group per (GROUP_TILES tiles,
// 4 * QUADS channels, position): reads their values and weights, writes their products.
kernel void winograd_gemm_multiply(
    const int ci,
    const int co,
    const int count,
    global const float4 *transformed,  // (...) of winograd_gemm_weights
    global float *scratch)             // (...)
{
    local float values[CHUNK * PITCH] __attribute__((aligned(16)));
    local float4 weights[CHUNK * QUADS];
    const int item = get_local_id(0), column = item % COLUMNS, row = item / COLUMNS;
    const int tile0 = get_group_id(0) * GROUP_TILES, quad0 = get_group_id(1) * QUADS;
    const int position = get_group_id(2);
    global const float *v = scratch + COUNTERS + position * count * ci;
    float4 acc[8][2];
#pragma unroll
    for (int i = 0; i < 8; i++)
        acc[i][0] = acc[i][1] = 0.0f;
    for (int c0 = 0; c0 < ci; c0 += CHUNK) {
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = item; i < GROUP_TILES * CHUNK / 4; i += ITEMS) {
            const int c = i % (CHUNK / 4) * 4, tile = i / (CHUNK / 4);
            // for those beyond the last, the last
            const int from = min(tile0 + tile, count - 1) * ci + c0 + c;
            const float4 value = *(global const float4 *)(v + from);
            local float *to = values + c * PITCH + tile;
            to[0] = value.x;
            to[PITCH] = value.y;
            to[2 * PITCH] = value.z;
            to[3 * PITCH] = value.w;
        }
        for (int i = item; i < CHUNK * QUADS; i += ITEMS)
            weights[i] =
                transformed[(position * ci + c0 + i / QUADS) * (co / 4) + quad0 + i % QUADS];
        barrier(CLK_LOCAL_MEM_FENCE);
// No more at a time: Intel's compiler, which takes SPIR-V, would hold the values of all in
// registers.
#ifdef __SPIR__
#pragma unroll 1
#else
#pragma unroll 2
#endif
        for (int c = 0; c < CHUNK; c++) {
            local const float4 *tiles = (local const float4 *)(values + c * PITCH) + row;
            local const float4 *quads = weights + c * QUADS + column;
            const float4 a = tiles[0], b = tiles[ROWS], w0 = quads[0], w1 = quads[COLUMNS];
            const float of_tile[8] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w};
#pragma unroll
            for (int i = 0; i < 8; i++) {
                acc[i][0] += of_tile[i] * w0;
                acc[i][1] += of_tile[i] * w1;
            }
        }
    }
    global float *m = scratch + COUNTERS + POSITIONS * count * ci + position * count * co;
#pragma unroll
    for (int i = 0; i < 8; i++) {
        const int tile = tile0 + (i / 4 * ROWS + row) * 4 + i % 4;
        global float4 *product = (global float4 *)(m + tile * co) + quad0 + column;
        if (tile < count) {
            product[0] = acc[i][0];
            product[COLUMNS] = acc[i][1];
        }
    }
}

// One work-item per (output channel, tile of the list from `first` on): reads its products at all
// positions, writes its outputs.
kernel void winograd_gemm_outputs(
    const int ci,
    const int co,
    const int first,
    const int count,
    const int biased,             // bias is added
    const int relu,               // negative results become 0
    const int masked,             // results become 0 where mask is not positive
    global const float *bias,     // (?)
    global const float *mask,     // (height, width, co)
    global const int *tile_list,  // (?) height, width, number, tiles
    global const float *scratch,  // (...)
    global float *out)            // (height, width, co)
{
    const int c = get_global_id(0), tile = get_global_id(1);
    if (c >= co || tile >= count) return;
    global const float *m = scratch + COUNTERS + POSITIONS * count * ci + tile * co + c;
    float t[POSITIONS];
#pragma unroll
    for (int i = 0; i < POSITIONS; i++)
        t[i] = m[i * count * co];
    transform_output_tile(t);
    const int height = tile_list[0], width = tile_list[1];
    const int2 corner = tile_corner(tile_list, first + tile);
    const float offset = biased ? bias[c] : 0.0f;
#pragma unroll
    for (int i = 0; i < WINO_M * WINO_M; i++) {
        const int px = corner.x + i % WINO_M, py = corner.y + i / WINO_M;
        if (px >= width || py >= height) continue;
        const size_t to = ((size_t)py * width + px) * co + c;
        float value = t[i / WINO_M * WINO_S + i % WINO_M] + offset;
        if (relu && value < 0.0f) value = 0.0f;  // max(., 0) would hide a NaN
        if (masked && !(mask[to] > 0.0f)) value = 0.0f;
        out[to] = value;
    }
}
