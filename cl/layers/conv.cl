// Direct K x K convolution (K = KERNEL_SIZE), stride 1, zero padding K / 2: the forward pass and
// the gradient of its input.
//
// A work-item keeps BLOCKS x 16 output channels of PIXELS neighbouring pixels of a row in
// registers. For each input channel it loads K weight vectors per block and PIXELS + K - 1
// scalars, and does K * BLOCKS * PIXELS vector multiply-adds with them. PIXELS and BLOCKS are
// chosen so that accumulators and weights fit a device's registers (Blocking in
// pp_cl/engine/layers/conv.py).
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

// One work-item per (PIXELS pixels, row, BLOCKS * 16 output channels): reads their neighbourhood in
// x, then in x2 (the concatenation [x, x2] without making it), and writes those of out that lie in
// a tile to compute.
kernel void conv_forward(
    const int height,
    const int width,
    const int c1,
    const int c2,  // channels of x2; 0 = x2 is not read
    const int co,
    const int relu,                  // negative results become 0
    global const float *x,           // (height, width, c1)
    global const float *x2,          // (height, width, ?)
    global const float16 *weight,    // ((co+15)/16, KERNEL_SIZE, KERNEL_SIZE, c1 + c2, 16)
    global const float16 *bias,      // ((co+15)/16*16)
    global const float *tile_count,  // ((height+3)/4, (width+3)/4) 0 = not computed
    global float *out)               // (height, width, co)
{
    const int tile_x = get_global_id(0) * PIXELS, y = get_global_id(1),
              block = get_global_id(2) * BLOCKS;
    if (tile_x >= width || y >= height || block * 16 >= co) return;
    // the last ones move left, and store only what their neighbours do not
    const int x0 = min(tile_x, width - PIXELS);
    if (!any_is_computed(tile_count, x0, y, width)) return;
    float16 acc[BLOCKS][PIXELS];
    UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
        UNROLLED_FOR (int p = 0; p < PIXELS; p++)
            acc[b][p] = bias[block + b];

    const int kx_stride = c1 + c2, block_stride = TAPS * kx_stride;
    for (int source = 0; source < (c2 ? 2 : 1); source++)
        convolve(
            acc, source ? x2 : x, weight + block * block_stride + source * c1, source ? c2 : c1,
            kx_stride, block_stride, x0, y, height, width);

    UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
        UNROLLED_FOR (int p = 0; p < PIXELS; p++)
            if (x0 + p >= tile_x && tile_is_computed(tile_count, x0 + p, y, width)) {
                // max(., 0) would hide a NaN
                const float16 value =
                    relu ? select(acc[b][p], (float16)(0.0f), acc[b][p] < 0.0f) : acc[b][p];
                store16(
                    value, out + ((size_t)y * width + x0 + p) * co + (block + b) * 16,
                    co - (block + b) * 16);
            }
}

// One work-item per (PIXELS pixels, row, BLOCKS * 16 input channels): reads grad_out, and writes
// those of grad_x that lie in a tile to compute: the convolution of grad_out with the flipped and
// transposed weights (conv_backward_weights.cl). masked: x is the output of a ReLU and grad_x the
// gradient of that ReLU's input, so that the mask costs no pass of its own.
kernel void conv_backward_input(
    const int height,
    const int width,
    const int c,
    const int co,
    const int masked,
    global const float *x,           // (height, width, c)
    global const float16 *flipped,   // ((c+15)/16, KERNEL_SIZE, KERNEL_SIZE, co, 16)
    global const float *grad_out,    // (height, width, co)
    global const float *tile_count,  // ((height+3)/4, (width+3)/4) 0 = not computed
    global float *grad_x)            // (height, width, c)
{
    const int tile_x = get_global_id(0) * PIXELS, y = get_global_id(1),
              block = get_global_id(2) * BLOCKS;
    if (tile_x >= width || y >= height || block * 16 >= c) return;
    const int x0 = min(tile_x, width - PIXELS);
    if (!any_is_computed(tile_count, x0, y, width)) return;
    float16 acc[BLOCKS][PIXELS];
    UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
        UNROLLED_FOR (int p = 0; p < PIXELS; p++)
            acc[b][p] = 0.0f;

    convolve(acc, grad_out, flipped + block * TAPS * co, co, co, TAPS * co, x0, y, height, width);

    UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
        UNROLLED_FOR (int p = 0; p < PIXELS; p++)
            if (x0 + p >= tile_x && tile_is_computed(tile_count, x0 + p, y, width)) {
                const size_t at = ((size_t)y * width + x0 + p) * c + (block + b) * 16;
                const int lanes = c - (block + b) * 16;
                const float16 dL_dx =
                    masked ? select((float16)0.0f, acc[b][p], load16(x + at, lanes) > 0.0f)
                           : acc[b][p];
                store16(dL_dx, grad_x + at, lanes);
            }
}
