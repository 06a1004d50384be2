// Direct K x K convolution (K = KERNEL_SIZE), stride 1, zero padding K / 2, of pixels of one row:
// what the forward pass (conv.cl) and the gradient of its input (conv_backward.cl) share.
//
// A work-item keeps BLOCKS x 16 output channels of PIXELS neighbouring pixels of a row in registers.
// For each input channel it loads K weight vectors per block and PIXELS + K - 1 scalars, for
// K * BLOCKS * PIXELS vector multiply-adds. All must fit a device's registers (Blocking in
// pp_cl/engine/layers/conv.py).
#ifndef PP_DIRECT_H
#define PP_DIRECT_H

#include "common.h"
#include "layers/tiles.h"
#include "vector.h"

#ifndef KERNEL_SIZE
#define KERNEL_SIZE 3  // side of the kernel: 1 or 3
#endif
#ifndef PIXELS
#define PIXELS 8  // pixels of one row, at most the width of the image
#endif
#ifndef BLOCKS
#define BLOCKS 1  // groups of 16 output channels
#endif
#define TAPS (KERNEL_SIZE * KERNEL_SIZE)
#define PAD (KERNEL_SIZE / 2)

// acc += convolution of x at pixels (x0 .. x0 + PIXELS - 1, y). weight: (block, ky, kx, channel) of
// x's first channel; kx_stride and block_stride: float16 between two kx, two blocks. Inlined by
// force: called out of line, PoCL's LLVM keeps acc in memory and halves the vector width.
ALWAYS_INLINE void convolve(
    float16 acc[BLOCKS][PIXELS],
    global const float *x,
    global const float16 *weight,
    const int channels,
    const int kx_stride,
    const int block_stride,
    const int x0,
    const int y,
    const int height,
    const int width) {
    // Columns -1 and PIXELS may lie outside: then the column beside is read, and masked to zero.
    const int left_mask = x0 > 0 ? -1 : 0, right_mask = x0 + PIXELS < width ? -1 : 0;
    const int left = -channels & left_mask,
              right = (PIXELS - 1) * channels + (channels & right_mask);
    for (int ky = 0; ky < KERNEL_SIZE; ky++) {
        const int row = y + ky - PAD;
        if (row < 0 || row >= height) continue;
        global const float *pixel = x + ((size_t)row * width + x0) * channels;
        global const float16 *w = weight + ky * KERNEL_SIZE * kx_stride;
        for (int c = 0; c < channels; c++) {
            float16 wc[BLOCKS][KERNEL_SIZE];
            UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
                    wc[b][kx] = w[b * block_stride + kx * kx_stride + c];
            UNROLLED_FOR (int column = -PAD; column < PIXELS + PAD; column++) {
                const float value = column < 0 ? as_float(as_int(pixel[left + c]) & left_mask)
                                    : column >= PIXELS
                                        ? as_float(as_int(pixel[right + c]) & right_mask)
                                        : pixel[column * channels + c];
                UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++) {
                    const int p = column - kx + PAD;
                    if (p >= 0 && p < PIXELS)
                        UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                            acc[b][p] += value * wc[b][kx];
                }
            }
        }
    }
}

// Whether any of the PIXELS pixels from (x0, y) on lies in a tile that is computed.
static inline bool
any_is_computed(global const float *tile_count, const int x0, const int y, const int width) {
    bool any = false;
    for (int x = x0; x < x0 + PIXELS + MAP_TILE - 1; x += MAP_TILE)
        any |= tile_is_computed(tile_count, min(x, x0 + PIXELS - 1), y, width);
    return any;
}

// One work-item's part of a convolution of [x, x2] (c2 = 0: of x), which is not made, to out and
// out2: PIXELS pixels of a row, BLOCKS * 16 channels, of which those in a tile to compute are
// written. weight: ((co1+15)/16+(co2+15)/16, K, K, c1 + c2, 16); bias: 0 = none; relu: negative
// results become 0; mask of either: 0 = none, results become 0 where it is not positive.
ALWAYS_INLINE void convolve_pixels(
    global const float *x,
    global const float *x2,
    const int c1,
    const int c2,
    global const float16 *weight,
    global const float16 *bias,
    const int relu,
    global const float *mask1,
    global const float *mask2,
    global float *out1,
    global float *out2,
    const int co1,
    const int co2,
    global const float *tile_count,
    const int3 item,
    const int height,
    const int width) {
    const int tile_x = item.x * PIXELS, y = item.y, first = item.z * BLOCKS;
    const bool second = first >= (co1 + 15) / 16;
    const int block = second ? first - (co1 + 15) / 16 : first, co = second ? co2 : co1;
    if (tile_x >= width || y >= height || block * 16 >= co) return;
    // the last ones move left, and store only what their neighbours do not
    const int x0 = min(tile_x, width - PIXELS);
    if (!any_is_computed(tile_count, x0, y, width)) return;
    float16 acc[BLOCKS][PIXELS];
    UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
        UNROLLED_FOR (int p = 0; p < PIXELS; p++)
            acc[b][p] = bias ? bias[block + b] : (float16)0.0f;

    const int kx_stride = c1 + c2, block_stride = TAPS * kx_stride;
    for (int source = 0; source < (c2 ? 2 : 1); source++)
        convolve(
            acc, source ? x2 : x, weight + first * block_stride + source * c1, source ? c2 : c1,
            kx_stride, block_stride, x0, y, height, width);

    global const float *mask = second ? mask2 : mask1;
    global float *out = second ? out2 : out1;
    UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
        UNROLLED_FOR (int p = 0; p < PIXELS; p++)
            if (x0 + p >= tile_x && tile_is_computed(tile_count, x0 + p, y, width)) {
                const size_t at = ((size_t)y * width + x0 + p) * co + (block + b) * 16;
                const int lanes = co - (block + b) * 16;
                float16 value = acc[b][p];
                if (relu)  // max(., 0) would hide a NaN
                    value = select(value, (float16)0.0f, value < 0.0f);
                if (mask) value = select((float16)0.0f, value, load16(mask + at, lanes) > 0.0f);
                store16(value, out + at, lanes);
            }
}

#endif
