// 3x3 convolution by Winograd's minimal filtering: the forward pass.
#include "layers/winograd.h"

// One work-item per compute unit: takes tiles, reads their neighbourhood in x, then in x2 (the
// concatenation [x, x2] without making it), and writes those tiles of out.
kernel void winograd_forward(
    const int c1,
    const int c2,  // channels of x2; 0 = x2 is not read
    const int co,
    const int relu,                // negative results become 0
    global const float *x,         // (height, width, c1)
    global const float *x2,        // (height, width, ?)
    global const float16 *weight,  // (36*(c1*co+c2*co+16)) transformed, as winograd.h says
    global const float16 *bias,    // (co)
    global const int *tile_list,   // (?)
    global float *out,             // (height, width, co)
    global float16 *scratch)       // (...) COUNTERS + work-items * SLICE(c1 + c2, co)
{
    convolve(
        x, x2, c1, c2, weight, bias, relu, 0, 0, out, 0, co, 0, tile_list, scratch,
        scratch + COUNTERS + get_global_id(0) * SLICE(c1 + c2, co));
}
