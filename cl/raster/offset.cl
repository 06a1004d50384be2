// Gradients of the offsets of points composited by alpha: what moving and shaping a point changes
// by the falloff d of its fragments. How the order of fragments and the harmonics change is left
// out.
//
// dL/dd = o/d dL/do (alpha.cl); each kind of point that learns offsets has the derivatives of d in
// its header.
#include "common.h"
#include "raster/footprint.h"

// One work-item per visible point: reads its pairs, writes the gradient of its offset, in edges of
// the grid and as cloud.h has it.
kernel void offset_backward(
    const uint s,                            // visible points
    const float voxel_size,                  // of the grid, world units
    const float radius,                      // of a point without offsets, world units
    global const uint *visible,              // (S) their indices
    global const float *camera,              // (21) camera.h
    global const float4 *point_camera,       // (N, 4) x, y, z, distance
    global const float *point_shape,         // (N, SHAPE) footprint.h
    global const float *cloud_offset,        // (?, OFFSETS) (N, OFFSETS), read of Gaussians
    global const float *opacity,             // (N)
    global const uint *point_offset,         // (N+1)
    global const uint *pair_pixel,           // (P)
    global const uint2 *pair_point_falloff,  // (P, 2) point, bits of d
    global const float2 *pair_gradient,      // (P, 2) b, what the fragment adds to dL/do
    global float *grad_offset)               // (?, OFFSETS) a row for each visible point
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const uint i = visible[g];
    const Camera cam = camera_load(camera);
    OffsetGradient sum = offset_begin(&cam, point_camera[i], point_shape + (size_t)SHAPE * i);
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        const float d = as_float(pair_point_falloff[pair].y);  // 0 at the very rim
        const float dL_do = pair_gradient[pair].y;             // 0 where the fragment is dropped
        if (d > 0.0f && dL_do != 0.0f)
            offset_add(&sum, &cam, pair_pixel[pair], d, opacity[i] * dL_do / d);
    }
    const Offsets offset = FORM > 1 ? OFFSETS_AT(cloud_offset, i) : (Offsets)(0.0f);
    OFFSETS_AT(grad_offset, g) = offset_end(&sum, &cam, voxel_size, radius, offset);
}
