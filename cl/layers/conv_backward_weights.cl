// The weight side of a K x K convolution (K = KERNEL_SIZE): its weight and bias gradients, and the
// flipped weights from which its input gradient is computed.
#include "lanes.h"
#include "layers/tiles.h"

#ifndef KERNEL_SIZE
#define KERNEL_SIZE 3  // side of the kernel: 1 or 3
#endif
#ifndef CI_GROUP
// input channels of one work-item; divides the channels. K * CI_GROUP accumulators fit AVX-512
#define CI_GROUP 8
#endif
#define TAPS (KERNEL_SIZE * KERNEL_SIZE)
#define PAD (KERNEL_SIZE / 2)
// pixels of a row summed in registers: one sum over an image of background would lose digits
#define SUMMED 128

// One work-item per (weights, output channel, tap, 16 input channels): reads 16 weights, writes them
// as one vector at the mirrored place. Lanes beyond the channels taken are 0. Rows of `table`: first
// work-item, taps (K * K), output channels, input channels taken, the first of them, input channels
// of the weights, where weights and vectors begin.
kernel void conv_flip_weights(
    const uint n,  // work-items
    const uint rows,
    global const int *table,      // (rows, 8)
    global const float *weights,  // (?) of all rows, each (blocks, K, K, ci, 16)
    global float16 *flipped)      // (...) of all rows, each (?, K, K, co, 16)
{
    const int item = get_global_id(0);
    if (item >= n) return;
    global const int *row = table;
    for (uint r = 1; r < rows && table[8 * r] <= item; r++)
        row += 8;
    const int taps = row[1], co = row[2], c = row[3], at = item - row[0];
    const int o = at % co, tap = at / co % taps, block = at / co / taps;
    global const float *weight = weights + row[6];
    float lane[16];
    for (int i = 0; i < 16; i++) {
        const int channel = block * 16 + i;
        lane[i] = channel < c
                      ? weight[(((o / 16) * taps + tap) * row[5] + row[4] + channel) * 16 + o % 16]
                      : 0.0f;
    }
    flipped[row[7] + (block * taps + taps - 1 - tap) * co + o] = vload16(0, lane);
}

// The gradients of 16 channels, `count` times; 0 where count is, whatever they are.
static inline float16 counted(global const float *grad, const float count, const int lanes) {
    return count > 0.0f ? count * load16(grad, lanes) : (float16)0.0f;
}

// One work-item per (CI_GROUP input channels and ky, 16 output channels, `rows` rows of the image):
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
    global const float *tile_count,  // ((height+3)/4, (width+3)/4) 0 = not read
    global float16 *partial)  // (?, (co+15)/16, KERNEL_SIZE*KERNEL_SIZE*ci+1, 16) of each part
{
    const int groups = c / CI_GROUP, item = get_global_id(0), blocks = (co + 15) / 16;
    const int block = get_global_id(1), part = get_global_id(2);
    if (item >= KERNEL_SIZE * groups || block >= blocks) return;
    const int ky = item / groups, c0 = item % groups * CI_GROUP, lanes = co - block * 16;
    const bool with_bias = ky == PAD && first + c0 == 0;
    global float16 *out = partial + ((size_t)part * blocks + block) * (TAPS * ci + 1),
                   *bias = out + TAPS * ci;
    out += ky * KERNEL_SIZE * ci + first + c0;
    for (int kx = 0; kx < KERNEL_SIZE; kx++)
        for (int i = 0; i < CI_GROUP; i++)
            out[kx * ci + i] = 0.0f;
    if (with_bias) *bias = 0.0f;

    const int end = min(height, (part + 1) * rows);
    for (int y = part * rows; y < end; y++) {
        const int row = y + ky - PAD;
        if (row < 0 || row >= height) continue;
        global const float *pixel = x + (size_t)row * width * c + c0;
        global const float *grad = grad_out + (size_t)y * width * co + block * 16;
        global const float *count = tile_count + y / SIDE * tile_columns(width);
        float16 window[KERNEL_SIZE];  // window[kx]: dL/dout at column + PAD - kx
        UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
            window[kx] = 0.0f;
        if (PAD) window[0] = counted(grad, count[0], lanes);
        for (int begin = 0; begin < width; begin += SUMMED) {
            float16 acc[KERNEL_SIZE][CI_GROUP], sum = 0.0f;
            UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
                UNROLLED_FOR (int i = 0; i < CI_GROUP; i++)
                    acc[kx][i] = 0.0f;
            for (int column = begin; column < min(begin + SUMMED, width); column++) {
                UNROLLED_FOR (int kx = KERNEL_SIZE - 1; kx > 0; kx--)
                    window[kx] = window[kx - 1];
                const int ahead = column + PAD;
                window[0] = ahead < width ? counted(grad + ahead * co, count[ahead / SIDE], lanes)
                                          : (float16)0.0f;
                // pixels that no counted gradient sees may hold anything
                if (count[max(column - PAD, 0) / SIDE] == 0.0f &&
                    count[min(column + PAD, width - 1) / SIDE] == 0.0f)
                    continue;
                UNROLLED_FOR (int i = 0; i < CI_GROUP; i++) {
                    const float value = pixel[column * c + i];
                    UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
                        acc[kx][i] += value * window[kx];
                }
                sum += window[PAD];
            }
            UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
                UNROLLED_FOR (int i = 0; i < CI_GROUP; i++)
                    out[kx * ci + i] += acc[kx][i];
            if (with_bias) *bias += sum;
        }
    }
}

// One work-item per part of (weights, row of partial, 16 output channels): adds the parts in order;
// writes LANES values of a gradient. Rows of `table`: first row of partial of all weights, rows of
// one part and group of 16 output channels (K * K * ci + 1), such groups, parts, where the parts,
// the gradient of the weights and that of the biases begin.
kernel void conv_sum_parts(
    const uint n,  // rows of partial, of one part of all weights
    const uint rows,
    global const int *table,        // (rows, 8)
    global const float16 *partial,  // (...) as above
    global float16 *grad_weights,   // (...)
    global float16 *grad_biases)    // (...)
{
    const int item = get_global_id(0) / ROW_PARTS;
    if (item >= n) return;
    global const int *of = table;
    for (uint r = 1; r < rows && table[8 * r] <= item; r++)
        of += 8;
    const int per_block = of[1], blocks = of[2], parts = of[3];
    const int row = (item - of[0]) % per_block, block = (item - of[0]) / per_block;
    floats sum = 0.0f;
    for (int part = 0; part < parts; part++)
        sum += load_part(partial, of[4] + ((size_t)part * blocks + block) * per_block + row);
    if (row < per_block - 1)
        store_part(sum, grad_weights, of[5] + block * (per_block - 1) + row);
    else
        store_part(sum, grad_biases, of[6] + block);
}
