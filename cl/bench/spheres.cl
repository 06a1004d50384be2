// Gradients of the positions and radii of spheres, for parity with Pulsar: no training needs them.
//
// l = o z / gamma + log d (softmax.cl): dL/dl = b gain, dL/dd = dL/dl / d, with the gain of
// raster/blend.cl.
#include "raster/footprint.h"
#include "raster/pair_role.h"
#include "reduce.h"

// as in raster/blend.cl
#ifndef HAS_PAIR_GAIN
#define HAS_PAIR_GAIN 1
#endif
#ifndef MEAN
#define MEAN 0
#endif

// One work-item per sphere: reads what blend_backward reads, writes dL/dl and dL/dd of its pairs.
kernel void spheres_backward_pairs(
    const uint n,                              // spheres
    global const uint *point_slot,             // (N) row of a visible point
    global const float16 *shaded_features,     // (?, 16) of the visible points
    global const uint *point_offset,           // (N+1)
    global const uint *pair_pixel,             // (P)
    global const float2 *pair_weight,          // (P, 2)
    global const uchar *pair_role,             // (?) P with HAS_ROLES
    global const float *pair_gain,             // (?) P with HAS_PAIR_GAIN
    global const float *pixel_rest,            // (?) HW without
    global const float16 *grad_features,       // (H, W, 16) G
    global const uint2 *pair_point_closeness,  // (P, 2) point, bits of d
    global float2 *grad_pair)                  // (P, 2) dL/dl, dL/dd
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    uint tracked = 0;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++)
        tracked += !HAS_ROLES || pair_role[pair] == TRACKED;
    const float scale = MEAN && tracked ? 1.0f / tracked : 1.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        const uint q = pair_pixel[pair];
        const float b = pair_weight[pair].x, d = as_float(pair_point_closeness[pair].y);
        float dL_dl = 0.0f;
        if (!HAS_ROLES || pair_role[pair] == TRACKED) {
            const float gain =
                HAS_PAIR_GAIN
                    ? pair_gain[pair]
                    : dot16(grad_features[q], shaded_features[point_slot[i]]) - pixel_rest[q];
            dL_dl = scale * b * gain;
        }
        grad_pair[pair] = (float2)(dL_dl, d > 0.0f ? dL_dl / d : 0.0f);
    }
}

// One work-item per sphere: reads the gradients of its pairs, writes those of its position and
// radius.
kernel void spheres_backward(
    const uint n,  // spheres
    const float gamma,
    global const float *camera,         // (20) camera.h
    global const float *point_radius,   // (N)
    global const float4 *point_camera,  // (N, 4) x, y, z, t
    global const float *opacity,        // (N)
    global const uint *point_offset,    // (N+1)
    global const uint *pair_pixel,      // (P)
    global const float2 *grad_pair,     // (P, 2) dL/dl, dL/dd
    global float *grad_positions,       // (N, 3) world
    global float *grad_radius)          // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const Camera cam = camera_load(camera);
    const float3 centre = point_camera[i].xyz;
    const float t = point_camera[i].w, radius = point_radius[i];
    const float width = t / least_focal(&cam), least = LEAST_RADIUS * width;
    const float dl_ddepth = -opacity[i] / (gamma * (cam.far - cam.near));
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

        // depth = along - half_chord; half_chord is the constant 0 where the ray misses the sphere
        // itself
        const float per_chord = half_chord > 0.0f ? 1.0f / half_chord : 0.0f;
        const float dL_ddepth = grad_pair[pair].x * dl_ddepth;
        dL_dc += dL_ddepth * (ray + per_chord * across);
        dL_dR -= dL_ddepth * radius * per_chord;

        // d = 1 - rho/R, but the constant 1 near the centre of tiny spheres; at the very centre it
        // has no slope
        if (rho > 0.0f && !(radius < width && rho < least)) {
            const float dL_dd = grad_pair[pair].y;
            dL_dc += dL_dd * (centre / t * dot(ray, delta) - delta) / (rho * radius);
            dL_dR += dL_dd * rho / (radius * radius);
        }
    }
    vstore3(dL_dc.x * cam.right + dL_dc.y * cam.down + dL_dc.z * cam.forward, i, grad_positions);
    grad_radius[i] = dL_dR;
}
