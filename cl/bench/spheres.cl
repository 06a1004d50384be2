// Gradients of the positions and radii of spheres, for parity with Pulsar: no training needs them.
//
// l = o z / gamma + log d (softmax.cl): dL/dl = b dL/db, dL/dd = dL/dl / d, with dL/db of
// raster/blend.cl, and from dL/do = b (1/o + z / gamma) dL/db: dL/dl = o / (1 + o z / gamma) dL/do.
#include "raster/footprint.h"

// One work-item per sphere: reads its pairs, writes the gradients of its position and radius.
kernel void spheres_backward(
    const uint n,  // spheres
    const float gamma,
    global const float *camera,              // (21) camera.h
    global const float4 *point_camera,       // (N, 4) x, y, z, t
    global const float *point_shape,         // (N, 1) radius
    global const float *opacity,             // (N)
    global const uchar *point_is_visible,    // (N) 0: has no gradients
    global const uint *point_offset,         // (N+1)
    global const uint *pair_pixel,           // (P)
    global const uint2 *pair_point_falloff,  // (P, 2) point, bits of d
    global const float2 *pair_gradient,      // (P, 2) b, dL/do
    global float *grad_positions,            // (N, 3) world
    global float *grad_radius)               // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    if (!point_is_visible[i]) {
        vstore3((float3)(0.0f), i, grad_positions);
        grad_radius[i] = 0.0f;
        return;
    }
    const Camera cam = camera_load(camera);
    const float3 centre = point_camera[i].xyz;
    const float t = point_camera[i].w, radius = point_shape[i];
    const float width = t / least_focal(&cam), least = LEAST_RADIUS * width;
    const float per_depth = 1.0f / (gamma * (cam.far - cam.near)),
                dl_ddepth = -opacity[i] * per_depth;
    float3 dL_dc = 0.0f;
    float dL_dR = 0.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        const uint q = pair_pixel[pair];
        const float3 ray = camera_ray(&cam, q % cam.width, q / cam.width);
        const float3 delta = centre - t * ray;
        const float rho = length(delta);
        const float along = fmin(dot(centre, ray), t);
        const float3 across = centre - along * ray;
        const float w = length(across);
        const float half_chord = sqrt((radius + w) * fmax(radius - w, 0.0f));
        const float d = as_float(pair_point_falloff[pair].y);
        const float a = opacity[i] * (cam.far - fmax(along - half_chord, 0.0f)) * per_depth;
        const float dL_dl = opacity[i] * pair_gradient[pair].y / (1.0f + a);

        // depth = along - half_chord; half_chord is the constant 0 where the ray misses the sphere
        // itself
        const float per_chord = half_chord > 0.0f ? 1.0f / half_chord : 0.0f;
        const float dL_ddepth = dL_dl * dl_ddepth;
        dL_dc += dL_ddepth * (ray + per_chord * across);
        dL_dR -= dL_ddepth * radius * per_chord;

        // d = 1 - rho/R, but the constant 1 near the centre of tiny spheres; at the very centre it
        // has no derivative
        if (rho > 0.0f && d > 0.0f && !(radius < width && rho < least)) {
            const float dL_dd = dL_dl / d;
            dL_dc += dL_dd * (centre / t * dot(ray, delta) - delta) / (rho * radius);
            dL_dR += dL_dd * rho / (radius * radius);
        }
    }
    vstore3(dL_dc.x * cam.right + dL_dc.y * cam.down + dL_dc.z * cam.forward, i, grad_positions);
    grad_radius[i] = dL_dR;
}
