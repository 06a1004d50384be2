// The gradients of the offsets of points composited by alpha, through the falloffs of their
// fragments: dL/dd = o/d dL/do. Each kind of point that has offsets has the derivatives of d in a
// header of its own. How the order of fragments and the harmonics change is left out.
#include "raster/samples.h"
#include "reduce.h"

#if OFFSETS == 4
#include "raster/offsets/soft.h"
#else
#include "raster/offsets/gaussian.h"
#endif

// One work-item per visible point: reads its pairs and their gradients, writes those of its offset,
// in edges of the grid and as cloud.h has it.
kernel void offset_gradient(
    const uint s,                           // visible points
    const float voxel_size,                 // of the grid, world units
    const float radius,                     // of a point without offsets, world units
    global const uint *visible,             // (?) their indices, S
    global const float *camera,             // (21) camera.h, of the samples
    global const float4 *point_camera,      // (N, 4) x, y, z, distance
    global const float *point_shape,        // (N, SHAPE) footprint.h
    global const float *cloud_offset,       // (N, OFFSETS) read of Gaussians, else may be NULL
    global const float *opacity,            // (N)
    global const uint *point_offset,        // (N+1)
    global const uint *pair_pixel,          // (P)
    global const uint *pair_point_falloff,  // (P, ?) point, with one sample bits of d
    global const float *pair_gradient,      // (P, 1+SAMPLES) b, s dL/db of each
    global float *grad_offset)              // (?, OFFSETS) a row for each visible point
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const uint i = visible[g];
    const Camera cam = camera_load(camera);
    const float4 c = point_camera[i];
    const float reach = reach_of(&cam, c, point_shape[(size_t)SHAPE * i]);
    OffsetGradient sum = offset_begin(&cam, c, point_shape + (size_t)SHAPE * i);
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        const floats dL_ds = LANES_FROM(pair_gradient + (size_t)(1 + SAMPLES) * pair + 1);
        if (!ANY_LANE(dL_ds != 0.0f)) continue;
        const Rays m = rays_of(&cam, pair_pixel[pair]);
#if SAMPLES == 1
        const floats d = as_float(vload2(pair, pair_point_falloff).y);
#else
        const floats d = falloffs(&m, c, reach);
#endif
        // d is 0 at the very rim
        const floats dL_dd = select((floats)(0.0f), opacity[i] * dL_ds / d, d > 0.0f);
        offset_add(&sum, &cam, pair_pixel[pair], &m, d, dL_dd);
    }
    const Offsets offset = FORM > 1 ? OFFSETS_AT(cloud_offset, i) : (Offsets)(0.0f);
    OFFSETS_AT(grad_offset, g) = offset_end(&sum, &cam, voxel_size, radius, offset);
}
