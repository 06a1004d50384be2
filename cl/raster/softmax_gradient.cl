// The softmax's part of the backward pass, which raster/blend.cl describes.
#include "common.h"
#include "reduce.h"

// One work-item per pixel: reads its `tracked` nearest fragments, writes the weight and the
// derivative of each by pair, and G.F. Each point has its own features at hand where it gathers its
// pairs, so that they are read once a point and not once a fragment.
kernel void softmax_gradient(
    const uint hw,                           // pixels
    const uint tracked,                      // fragments of a pixel that get gradients
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pair_key,            // (P) depth << 32 | pair
    global const ulong *pixel_weight_point,  // (P) weight << 32 | point; no point: the list ends
    global const float *pixel_derivative,    // (P, 1)
    global const float16 *features,          // (H, W, 16) F
    global const float16 *grad_features,     // (H, W, 16) G
    global float2 *pair_gradient,            // (P, 2) b, s; cleared before
    global float *pixel_blend)               // (HW) G.F
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const uint begin = pixel_offset[q], end = begin + min(pixel_offset[q + 1] - begin, tracked);
    for (uint i = begin; i < end && (uint)pixel_weight_point[i] != NONE; i++)
        pair_gradient[(uint)pair_key[i]] =
            (float2)(upper_float(pixel_weight_point[i]), pixel_derivative[i]);
    pixel_blend[q] = dot16(grad_features[q], features[q]);
}
