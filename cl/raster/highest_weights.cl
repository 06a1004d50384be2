// Each point's highest blend weight in an image, by which it is pruned, for views without gradients.
#include "common.h"

// One work-item per point with a pair: sums the weights of its pairs, keeps the sum if it is the
// highest so far, and counts the view if the sum is at least `least`.
kernel void record_weights(
    const uint n,                          // points
    const float least,                     // weight of a point that counts as seen
    global const uint *point_offset,       // (N+1) first pair of each point
    global const uchar *point_is_visible,  // (N) 1: shows in a sample
    global const float *pair_weight,       // (P) sums of weights, weights.cl
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
            sum += pair_weight[pair];
        if (sum > max_weight[i] || isnan(sum)) max_weight[i] = sum;  // fmax() would hide a NaN
    }
    if (sum >= least) times_seen[i] += 1.0f;
}
