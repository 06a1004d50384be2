// Direct K x K convolution (K = KERNEL_SIZE), stride 1, zero padding K / 2, of pixels of one row:
// what the forward pass (conv.cl) and the gradient of its input (conv_backward.cl) share.
//
// A work-item keeps BLOCKS x 16 output channels of PIXELS neighbouring pixels of a row in
// registers. For each input channel it loads K weight vectors per block and PIXELS + K - 1
// scalars, and does K * BLOCKS * PIXELS vector multiply-adds with them. PIXELS and BLOCKS are
// chosen so that accumulators and weights fit a device's registers (Blocking in
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
    for (int x = x0; x < x0 + PIXELS + SIDE - 1; x += SIDE)
        any |= tile_is_computed(tile_count, min(x, x0 + PIXELS - 1), y, width);
    return any;
}

#endif
