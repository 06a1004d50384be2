// The gradients of the visible points, from what the tiles wrote by pair (blend.cl).
#include "common.h"
#include "camera.h"
#include "lanes.h"
#include "raster/footprint.h"

#define SUMS 8  // of a pair, as blend.cl has them
#ifndef MOVED
#define MOVED MOVES
#endif

// One work-item per part of a visible point: sums what the tiles wrote by pair, and writes the
// gradients of its features and, the first one, of its opacity and of its offset, in edges of the
// grid and as cloud.h has it; and the sum of its blend weights if it is the highest so far.
kernel void gather_pairs(
    const uint s,                            // visible points
    const int is_recorded,                   // 0: max_weight is not touched
    const float voxel_size,                  // of the grid, world units; 0: no gradients of offsets
    const float radius,                      // of a point without offsets, world units
    global const uint *visible,              // (?) their indices, S
    global const float *camera,              // (21) camera.h, of the samples
    global const uint *point_record,         // (N, RECORD) footprint.h
    global const uint *point_offset,         // (N+1)
    global const float *cloud_offset,        // (N, OFFSETS) read of Gaussians
    global const float16 *pair_features,     // (P, 16)
    global const float8 *pair_sums,          // (P, SUMS)
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
    floats dL_df = 0.0f;
    float8 sums = 0.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        if (!pair_shows[pair]) continue;
        dL_df += load_part(pair_features, pair);
        if (ROW_PART == 0) sums += pair_sums[pair];
    }
    // features that shade.cl has clamped to 0 have no gradient
    if (CLAMPED) dL_df = load_part(visible_features, g) == 0.0f ? 0.0f : dL_df;
    store_part(dL_df, grad_visible_features, g);
    if (ROW_PART > 0) return;
    grad_opacity[g] = sums.s1;
#if MOVED
    if (voxel_size > 0.0f) {
        const Camera cam = camera_load(camera);
        const Point point = POINT_OF(point_record, i);
        const Offsets offset = FORM > 1 ? OFFSETS_AT(cloud_offset, i) : (Offsets)(0.0f);
        float of_form[SUMS];
        vstore8(sums, 0, of_form);
        OFFSETS_AT(grad_offset, g) = derivatives_end(
            of_form + 2, point.opacity * sums.s1, &cam, &point, voxel_size, radius, offset);
    }
#endif
    const float weight = sums.s0 / SAMPLES;
    // fmax() would hide a NaN
    if (is_recorded && (weight > max_weight[i] || isnan(weight))) max_weight[i] = weight;
}
