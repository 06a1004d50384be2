// Features blended by the weights of softmax.cl or alpha.cl, and gradients by gathering.
//
// F = sum b_i f_i + b_0 * 1, with G = dL/dF
// dL/df_i = sum b_i G,  dL/do_i = sum s_i (G.f_i - rest)
//
// s_i is the second value of pair_weight; rest is what takes the place of a hit that fades: in the
// softmax all of the pixel's hits, G.F, in alpha compositing those behind it, where alpha.cl has
// computed the difference already.
//
// vec_type_hint: the vectors are written out; Intel's compiler would merge work-items into wider
// ones, up to 8 times slower.
#include "common.h"
#include "lanes.h"
#include "raster/footprint.h"
#include "raster/pair_role.h"
#include "reduce.h"

#ifndef HAS_ROLES
#define HAS_ROLES 1  // 0: every pair is tracked, and pair_role is not read
#endif
#ifndef GAIN_BY_PAIR
#define GAIN_BY_PAIR 0  // 1: G.f_i - rest of each pair is given; 0: rest of each pixel
#endif
#ifndef MEAN
#define MEAN 0  // 1: gradients are divided by the number of pixels that track the point (Pulsar)
#endif

// G.f_i - rest of a pair in pixel q; `product`, G.f_i, is computed only where it is needed
#define GAIN(pair, q, product) (GAIN_BY_PAIR ? rest_or_gain[pair] : (product) - rest_or_gain[q])

// One work-item per part of a pixel: reads its hits and their points' features, writes the blended
// features.
kernel void blend_forward(
    const uint hw,                         // pixels
    global const uint *pixel_offset,       // (HW+1)
    global const ulong *pixel_entry,       // (P) weight << 32 | point; no point: the list ends
    global const float16 *point_features,  // (N, 16)
    global float16 *features)              // (H, W, 16)
{
    const uint q = get_global_id(0) / ROW_PARTS;
    if (q >= hw) return;
    floats sum = 0.0f;
    float weights = 0.0f;
    for (uint i = pixel_offset[q]; i < pixel_offset[q + 1] && (uint)pixel_entry[i] != NONE; i++) {
        const float b = as_float((uint)(pixel_entry[i] >> 32));
        sum += b * load_part(point_features, (uint)pixel_entry[i]);
        weights += b;
    }
    // the background's features are 1, its weight is what is left
    store_part(sum + (1.0f - weights), features, q);
}

// One work-item per part of a point: reads its pairs and their pixels' gradients, writes the
// gradients of its features and, the first one, of its opacity.
kernel __attribute__((vec_type_hint(floats))) void blend_backward(
    const uint n,                          // points
    global const float16 *point_features,  // (N, 16)
    global const uint *point_offset,       // (N+1)
    global const uint *pair_pixel,         // (P)
    global const float2 *pair_weight,      // (P, 2)
    global const uchar *pair_role,         // (?) P with HAS_ROLES
    global const float16 *grad_features,   // (H, W, 16) G
    global const float *rest_or_gain,      // (HW) rest, or with GAIN_BY_PAIR (P) G.f_i - rest
    global float16 *grad_point_features,   // (N, 16)
    global float *grad_opacity)            // (N)
{
    const uint i = get_global_id(0) / ROW_PARTS;
    if (i >= n) return;
    floats dL_df = 0.0f;
    float dL_do = 0.0f;
    uint tracked = 0;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        if (HAS_ROLES && pair_role[pair] != TRACKED) continue;
        const float2 weight = pair_weight[pair];
        const uint q = pair_pixel[pair];
        dL_df += weight.x * load_part(grad_features, q);
        dL_do += weight.y * GAIN(pair, q, dot16(grad_features[q], point_features[i]));
        tracked++;
    }
    const float scale = MEAN && tracked ? 1.0f / tracked : 1.0f;
    store_part(scale * dL_df, grad_point_features, i);
    if (ROW_PART == 0) grad_opacity[i] = scale * dL_do;
}

// Sum of the products of two rows, LANES channels at a time.
static inline float dot_rows(global const float16 *a, global const float16 *b) {
    global const floats *p = (global const floats *)a, *q = (global const floats *)b;
    floats products = p[0] * q[0];
    for (uint part = 1; part < ROW_PARTS; part++)
        products += p[part] * q[part];
    return SUM_LANES(products);
}

// One work-item per point: reads what blend_backward reads, writes dL/dl and dL/dd = dL/dl / d of
// its pairs (see the top).
kernel void blend_backward_pairs(
    const uint n,                              // points
    global const float16 *point_features,      // (N, 16)
    global const uint *point_offset,           // (N+1)
    global const uint *pair_pixel,             // (P)
    global const float2 *pair_weight,          // (P, 2)
    global const uchar *pair_role,             // (?) P with HAS_ROLES
    global const float16 *grad_features,       // (H, W, 16) G
    global const float *rest_or_gain,          // (HW) rest, or with GAIN_BY_PAIR (P) G.f_i - rest
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
        if (!HAS_ROLES || pair_role[pair] == TRACKED)
            dL_dl = scale * b * GAIN(pair, q, dot_rows(grad_features + q, point_features + i));
        grad_pair[pair] = (float2)(dL_dl, d > 0.0f ? dL_dl / d : 0.0f);
    }
}

// One work-item per sphere: reads the gradients of its pairs, writes those of its position and
// radius.
kernel void blend_backward_spheres(
    const uint n,      // spheres
    const uint radii,  // 1 (all alike) or n
    const float gamma,
    global const float *camera,         // (20) camera.h
    global const float *point_radius,   // (radii)
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
    const float t = point_camera[i].w, radius = point_radius[radii == 1 ? 0 : i];
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
