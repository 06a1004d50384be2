// What tiles wrote by pair, summed by point: gradients (blend.cl) and weights (highest_weights.cl).
#include "common.h"
#include "camera.h"
#include "lanes.h"
#include "raster/footprint.h"

#ifndef MOVED
#define MOVED MOVES
#endif
#include "raster/sums.h"

// One work-item per part of a visible point: sums what the tiles wrote by pair, and writes the
// gradients of its features and, the first one, of its opacity and of its offset, in edges of the
// grid and as cloud.h has it; and the sum of its blend weights if it is the highest so far.
kernel void gather_pairs(
    const uint s,                            // visible points
    const int is_recorded,                   // 0: max_weight is not touched
    const float voxel_size,                  // of the grid, world units; read with MOVED
    const float radius,                      // of a point without offsets, world units
    global const uint *visible,              // (?) their indices, S
    global const float *camera,              // (21) camera.h, of the samples
    global const uint *point_record,         // (N, RECORD) footprint.h
    global const uint *point_offset,         // (N+1)
    global const float *cloud_offset,        // (N, OFFSETS) read of Gaussians
    global const float16 *pair_features,     // (P, 16)
    global const float *pair_sums,           // (P, SUMS)
    global const uchar *pair_shows,          // (P) 0: not written
    global const float16 *visible_features,  // (?, 16) a row for each, read with CLAMPED
    global float16 *grad_visible_features,   // (?, 16) alike
    global float *grad_opacity,              // (?) alike
    global float *grad_offset,               // (?, OFFSETS) alike, NULL without MOVED
    global float *max_weight)                // (N) read and written, NULL if not is_recorded
{
    const uint g = get_global_id(0) / ROW_PARTS;
    if (g >= s) return;
    const uint i = visible[g];
    const bool is_written = !CLAMPED && point_offset[i + 1] - point_offset[i] == 1;  // by its tile
    if (is_written && ROW_PART > 0) return;
    floats dL_df = 0.0f;
    Sums all = 0.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        if (!pair_shows[pair]) continue;
        if (!is_written) dL_df += load_part(pair_features, pair);
        if (ROW_PART == 0) all += LOAD_SUMS(pair, pair_sums);
    }
    // features that shade.cl has clamped to 0 have no gradient
    if (CLAMPED) dL_df = load_part(visible_features, g) == 0.0f ? 0.0f : dL_df;
    if (!is_written) store_part(dL_df, grad_visible_features, g);
    if (ROW_PART > 0) return;
    float sums[SUMS];
    STORE_SUMS(all, 0, sums);
    grad_opacity[g] = sums[1];
#if MOVED
    const Camera cam = camera_load(camera);
    const Point point = POINT_OF(point_record, i);
    const Offsets offset = FORM > 1 ? OFFSETS_AT(cloud_offset, i) : (Offsets)(0.0f);
    OFFSETS_AT(grad_offset, g) = derivatives_end(
        sums + 2, point.opacity * sums[1], &cam, &point, voxel_size, radius, offset);
#endif
    const float weight = sums[0] / SAMPLES;
    // fmax() would hide a NaN
    if (is_recorded && (weight > max_weight[i] || isnan(weight))) max_weight[i] = weight;
}

// One work-item per point with a pair: sums the weights of its pairs, keeps the sum if it is the
// highest so far, and counts the view if the sum is at least `least`.
kernel void record_weights(
    const uint n,                          // points
    const float least,                     // weight of a point that counts as seen
    global const uint *point_offset,       // (N+1) first pair of each point
    global const uchar *point_is_visible,  // (N) 1: shows in a sample
    global const float *pair_weight,       // (P) sums of weights
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
