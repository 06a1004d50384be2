// What the pixels write for each pair: cleared, as they leave out the fragments that they drop.
#include "common.h"

#ifndef SAMPLES
#define SAMPLES 1  // of a pixel
#endif

// One work-item per visible point: clears its pairs, of which the pixels then write those that they
// do not drop.
kernel void clear_pairs(
    const uint s,                     // visible points
    global const uint *visible,       // (?) their indices, S
    global const uint *point_offset,  // (N+1)
    global float *pair_gradient)      // (P, 1+SAMPLES)
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const size_t row = 1 + SAMPLES, end = row * point_offset[visible[g] + 1];
    for (size_t at = row * point_offset[visible[g]]; at < end; at++)
        pair_gradient[at] = 0.0f;
}
