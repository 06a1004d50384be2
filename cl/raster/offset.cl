// Gradients of the offsets of soft points, composited by alpha: what moving and widening a point
// changes by the closeness d of its hits. How the order of hits and the harmonics change is left out.
//
// d = 1 - rho / h with rho = |e|, e = c - (c.r) r: of the centre c from the unit ray r
// dd/dc = -e / (rho h),   dL/dd = o T gain (alpha.cl, blend.cl)
// With m along the ray, of any length: e = c - (c.m)/(m.m) m, which takes no root.
//
// dd/d(log h) = rho / h = 1 - d. The least h is not the point's own and grows with the range t = |c|:
// then dd/dc has rho/h^2 dh/dc = (1 - d) c/t^2 more instead.
#include "common.h"
#include "camera.h"
#include "raster/footprint.h"
#include "raster/pair_role.h"

#define LEAST_RHO 1e-3f  // of h: nearer to its ray a point has no direction away from it

// One work-item per visible point: reads its pairs, writes the gradient of its offset and of the
// logarithm of its radius.
kernel void offset_backward(
    const uint s,                              // visible points
    const float edge,                          // of the grid, world units
    global const uint *shaded,                 // (S) their indices
    global const float *camera,                // (20) camera.h
    global const float *point_radius,          // (N)
    global const float4 *point_camera,         // (N, 4) x, y, z, distance
    global const float *opacity,               // (N)
    global const uint *point_offset,           // (N+1)
    global const uint *pair_pixel,             // (P)
    global const uint2 *pair_point_closeness,  // (P, 2) point, bits of d
    global const float2 *pair_weight,          // (P, 2) b, T d
    global const uchar *pair_role,             // (?) P with HAS_ROLES
    global const float *pair_gain,             // (P)
    global float4 *grad_offset)                // (?, 4) a row for each of them
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const uint i = shaded[g];
    const Camera cam = camera_load(camera);
    const float3 c = point_camera[i].xyz;
    const float t = point_camera[i].w;
    const float h = fmax(point_radius[i], LEAST_RADIUS * t / least_focal(&cam));
    const float growth = h > point_radius[i] ? 1.0f / (t * t) : 0.0f;
    const float per_fx = 1.0f / cam.fx, per_fy = 1.0f / cam.fy;
    float3 dL_dc = 0.0f;
    float dL_dlog = 0.0f;  // of h
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        if (HAS_ROLES && pair_role[pair] != TRACKED) continue;
        const float d = as_float(pair_point_closeness[pair].y);
        if (d <= 0.0f) continue;  // the very rim
        const uint q = pair_pixel[pair];
        const float mx = (q % cam.width + 0.5f - cam.cx) * per_fx;
        const float my = (q / cam.width + 0.5f - cam.cy) * per_fy;
        const float3 m = (float3)(mx, my, 1.0f), e = c - dot(c, m) / dot(m, m) * m;
        const float dL_dd = opacity[i] * pair_weight[pair].y / d * pair_gain[pair];
        const float per_rho_h = 1.0f / (fmax(1.0f - d, LEAST_RHO) * h * h);
        dL_dlog += dL_dd * (1.0f - d);
        dL_dc += dL_dd * (growth * (1.0f - d) * c - per_rho_h * e);
    }
    const float3 world = edge * (dL_dc.x * cam.right + dL_dc.y * cam.down + dL_dc.z * cam.forward);
    grad_offset[g] = (float4)(world, growth > 0.0f ? 0.0f : dL_dlog);
}
