// Each point's highest blend weight in an image, by which it is pruned, for views without gradients.
#include "common.h"

// One work-item per pixel: writes the weights of its `tracked` nearest fragments by pair.
kernel void list_weights(
    const uint hw,                           // pixels
    const uint tracked,                      // fragments of a pixel that count
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pair_key,            // (P) depth << 32 | pair
    global const ulong *pixel_weight_point,  // (P) weight << 32 | point; no point: the list ends
    global float2 *pair_gradient)            // (P, 2) b, 0; cleared before
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const uint begin = pixel_offset[q], count = pixel_offset[q + 1] - begin;
    for (uint i = begin; i < begin + min(count, tracked) && (uint)pixel_weight_point[i] != NONE;
         i++) {
        const float b = as_float((uint)(pixel_weight_point[i] >> 32));
        pair_gradient[(uint)pair_key[i]] = (float2)(b, 0.0f);
    }
}

// One work-item per point with a pair: sums the weights of its pairs, keeps the sum if it is the
// highest so far, and counts the view if the sum is at least `least`.
kernel void record_weights(
    const uint n,                          // points
    const float least,                     // weight of a point that counts as seen
    global const uint *point_offset,       // (N+1)
    global const uchar *point_is_visible,  // (N) 1: not all of its pairs are dropped
    global const float2 *pair_gradient,    // (P, 2) b first; read of visible points
    global float *max_weight,              // (N) read and written
    global float *times_seen)              // (N) accumulates
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const uint begin = point_offset[i], end = point_offset[i + 1];
    if (begin == end) return;
    float sum = 0.0f;
    if (point_is_visible[i]) {
        for (uint pair = begin; pair < end; pair++)
            sum += pair_gradient[pair].x;
        if (sum > max_weight[i] || isnan(sum)) max_weight[i] = sum;  // fmax() would hide a NaN
    }
    if (sum >= least) times_seen[i] += 1.0f;
}
