// The gradients of the offsets of soft points with several samples of a pixel.
#include "raster/samples.h"
#include "reduce.h"

// One work-item per visible point: reads its pairs and their gradients, writes those of its offset,
// in edges of the grid and as cloud.h has it, as offset_add() sums them.
kernel void sampled_offsets(
    const uint s,                       // visible points
    const float voxel_size,             // of the grid, world units
    global const uint *visible,         // (?) their indices, S
    global const float *camera,         // (21) camera.h, of the samples
    global const float4 *point_camera,  // (N, 4) x, y, z, distance
    global const float *point_shape,    // (N, SHAPE) footprint.h
    global const float *opacity,        // (N)
    global const uint *point_offset,    // (N+1)
    global const uint *pair_pixel,      // (P)
    global const float *pair_gradient,  // (P, 1+SAMPLES) b, s dL/db of each
    global float *grad_offset)          // (?, OFFSETS) a row for each visible point
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const uint i = visible[g];
    const Camera cam = camera_load(camera);
    const float4 c = point_camera[i];
    OffsetGradient sum = offset_begin(&cam, c, point_shape + (size_t)SHAPE * i);
    const float per_h = 1.0f / sum.h;
    floats dx = 0.0f, dy = 0.0f, dz = 0.0f, dlog = 0.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        const floats dL_ds = LANES_FROM(pair_gradient + (size_t)(1 + SAMPLES) * pair + 1);
        if (!ANY_LANE(dL_ds != 0.0f)) continue;
        const Rays m = rays_of(&cam, pair_pixel[pair]);
        const floats d = falloffs(&m, c, sum.h), rest = 1.0f - d;  // 0 at the very rim
        const floats dL_dd = select((floats)(0.0f), opacity[i] * dL_ds / d, d > 0.0f);
        const floats along = (c.x * m.x + c.y * m.y + c.z) / m.length2;
        const floats inward = dL_dd * per_h * per_h / fmax(rest, LEAST_RHO);
        const floats outward = dL_dd * sum.growth * rest;
        dx += outward * c.x - inward * (c.x - along * m.x);
        dy += outward * c.y - inward * (c.y - along * m.y);
        dz += outward * c.z - inward * (c.z - along);
        dlog += dL_dd * rest;
    }
    sum.dL_dc = (float3)(SUM_LANES(dx), SUM_LANES(dy), SUM_LANES(dz));
    sum.dL_dlog = SUM_LANES(dlog);
    OFFSETS_AT(grad_offset, g) = offset_end(&sum, &cam, voxel_size, 0.0f, (Offsets)(0.0f));
}
