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
    convolve_pixels(
        x, x2, c1, c2, weight, bias, relu, 0, 0, out, 0, co, 0, tile_count,
        (int3)(get_global_id(0), get_global_id(1), get_global_id(2)), height, width);
}
