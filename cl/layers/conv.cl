// Direct K x K convolution (direct.h): the forward pass.
#include "layers/direct.h"

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
