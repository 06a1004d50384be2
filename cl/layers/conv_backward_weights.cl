// The weight side of a K x K convolution: its weight and bias gradients, and the weights its input
// gradient is made with.
#include "common.h"
#include "layers/tiles.h"
#include "vector.h"

#ifndef K
#define K 3  // side of the kernel: 1 or 3
#endif
#ifndef CI_TILE
// input channels of one work-item; divides the channels. K * CI_TILE accumulators fit AVX-512
#define CI_TILE 8
#endif
#define PAD (K / 2)
// pixels of a row summed in registers: one sum over an image of background would lose digits
#define SUMMED 128

// One work-item per (output channel, ky * K + kx, 16 input channels from `first` on): reads 16
// weights, writes them as one vector at the mirrored place. Lanes beyond c are 0.
kernel void conv_flip_weights(
    const int c,  // channels taken
    const int co,
    const int first,             // first channel taken
    const int ci,                // channels of weight
    global const float *weight,  // (?, K, K, ci, 16)
    global float16 *flipped)     // (?, K, K, co, 16)
{
    const int o = get_global_id(0), tap = get_global_id(1), block = get_global_id(2);
    if (o >= co || tap >= K * K) return;
    float lane[16];
    for (int i = 0; i < 16; i++) {
        const int channel = block * 16 + i;
        lane[i] = channel < c
                      ? weight[(((o / 16) * K * K + tap) * ci + first + channel) * 16 + o % 16]
                      : 0.0f;
    }
    flipped[(block * K * K + K * K - 1 - tap) * co + o] = vload16(0, lane);
}

// The gradients of 16 channels, `count` times; 0 where count is, whatever they are.
static inline float16 counted(global const float *grad, const float count, const int lanes) {
    return count > 0.0f ? count * load16(grad, lanes) : (float16)0.0f;
}

// One work-item per (CI_TILE input channels and ky, 16 output channels, `rows` rows of the image):
// walks its rows of x with the gradients of the K output pixels that see each pixel, and writes its
// part of the sums: dL/dweight in rows (ky, kx, channel) of partial, dL/dbias in the last row.
// Needs no border test: it visits only pixels that exist. A gradient counts as often as its tile.
kernel void conv_backward_weights(
    const int height,
    const int width,
    const int c,
    const int co,
    const int first,  // channel of the weights where x begins
    const int ci,     // channels of the weights
    const int rows,
    global const float *x,           // (height, width, c)
    global const float *grad_out,    // (height, width, co)
    global const float *tile_count,  // (?, ?) of grad_out, 0 = not read
    global float16 *partial)  // (...) at least (parts, co / 16 rounded up, K * K * ci + 1, 16)
{
    const int groups = c / CI_TILE, item = get_global_id(0), blocks = (co + 15) / 16;
    const int block = get_global_id(1), part = get_global_id(2);
    if (item >= K * groups || block >= blocks) return;
    const int ky = item / groups, c0 = item % groups * CI_TILE, lanes = co - block * 16;
    const bool with_bias = ky == PAD && first + c0 == 0;
    global float16 *out = partial + ((size_t)part * blocks + block) * (K * K * ci + 1),
                   *bias = out + K * K * ci;
    out += ky * K * ci + first + c0;
    for (int kx = 0; kx < K; kx++)
        for (int i = 0; i < CI_TILE; i++)
            out[kx * ci + i] = 0.0f;
    if (with_bias) *bias = 0.0f;

    const int end = min(height, (part + 1) * rows);
    for (int y = part * rows; y < end; y++) {
        const int row = y + ky - PAD;
        if (row < 0 || row >= height) continue;
        global const float *pixel = x + (size_t)row * width * c + c0;
        global const float *grad = grad_out + (size_t)y * width * co + block * 16;
        global const float *count = tile_count + y / SIDE * tile_columns(width);
        float16 window[K];  // window[kx]: dL/dout at column + PAD - kx
#pragma unroll
        for (int kx = 0; kx < K; kx++)
            window[kx] = 0.0f;
        if (PAD) window[0] = counted(grad, count[0], lanes);
        for (int begin = 0; begin < width; begin += SUMMED) {
            float16 acc[K][CI_TILE], sum = 0.0f;
#pragma unroll
            for (int kx = 0; kx < K; kx++)
#pragma unroll
                for (int i = 0; i < CI_TILE; i++)
                    acc[kx][i] = 0.0f;
            for (int column = begin; column < min(begin + SUMMED, width); column++) {
#pragma unroll
                for (int kx = K - 1; kx > 0; kx--)
                    window[kx] = window[kx - 1];
                const int ahead = column + PAD;
                window[0] = ahead < width ? counted(grad + ahead * co, count[ahead / SIDE], lanes)
                                          : (float16)0.0f;
                if (!PAD && count[column / SIDE] == 0.0f) continue;
#pragma unroll
                for (int i = 0; i < CI_TILE; i++) {
                    const float value = pixel[column * c + i];
#pragma unroll
                    for (int kx = 0; kx < K; kx++)
                        acc[kx][i] += value * window[kx];
                }
                sum += window[PAD];
            }
#pragma unroll
            for (int kx = 0; kx < K; kx++)
#pragma unroll
                for (int i = 0; i < CI_TILE; i++)
                    out[kx * ci + i] += acc[kx][i];
            if (with_bias) *bias += sum;
        }
    }
}

// One work-item per (row of partial, 16 output channels): adds the parts in order; writes one
// vector of a gradient.
kernel void conv_sum_parts(
    const int per_block,  // K * K * ci, rows of one block of weights
    const int blocks,
    const int parts,
    global const float16 *partial,  // (...) as above
    global float16 *grad_weight,    // (blocks, K, K, ?, 16)
    global float16 *grad_bias)      // (?)
{
    const int row = get_global_id(0), block = get_global_id(1);
    if (row > per_block || block >= blocks) return;
    float16 sum = 0.0f;
    for (int part = 0; part < parts; part++)
        sum += partial[((size_t)part * blocks + block) * (per_block + 1) + row];
    if (row < per_block)
        grad_weight[block * per_block + row] = sum;
    else
        grad_bias[block] = sum;
}
