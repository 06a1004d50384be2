// What follows for the points from the blend weights of their hits: each one's highest weight, by
// which it is pruned.
#include "common.h"
#include "raster/pair_role.h"

// One work-item per point with a pair: sums the weights of its pairs, keeps the sum if it is the
// highest so far, and counts the view if the sum is at least `least`.
kernel void record_weights(
    const uint n,                         // points
    const float least,                    // weight of a point that counts as seen
    global const uint *point_offset,      // (N+1)
    global const uchar *point_is_shaded,  // (N) 1: not all of its pairs are dropped
    global const float2 *pair_weight,     // (P, 2)
    global const uchar *pair_role,        // (?) P with HAS_ROLES
    global float *max_weight,             // (N) read and written
    global float *times_seen)             // (N) accumulates
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const uint begin = point_offset[i], end = point_offset[i + 1];
    if (begin == end) return;
    float sum = 0.0f;
    if (point_is_shaded[i]) {
        for (uint pair = begin; pair < end; pair++) {
            const float weight = pair_weight[pair].x;
            // no branch, which processors could not foresee
            sum += HAS_ROLES && pair_role[pair] == DROPPED ? 0.0f : weight;
        }
        max_weight[i] = fmax(max_weight[i], sum);
    }
    if (sum >= least) times_seen[i] += 1.0f;
}
