// Eq. (1) of the PlenopticPoints supplemental: each pixel's softmax over its hits, and its gradients by gathering.
//
// l_i = ln(o_i d_i) + o_i z_i/gamma,  b_i = exp(l_i - M)/D,  b_0 = exp(EPS/gamma - M)/D,  F = sum b_i f_i + b_0 * 1
// with M = max(EPS/gamma, max l_i) and D the sum of the exponentials, so that no exponent is positive and D >= 1.
//
// vec_type_hint: the vectors are written out; Intel's compiler would merge work-items into wider ones, up to 8 times slower.
#include "common.h"
#include "footprint.h"

#ifndef MEAN
#define MEAN 0                   // 1: gradients are divided by the number of pixels that track the point (Pulsar)
#endif

#define EPS 1e-6f                // depth of the background, as a z (Pulsar's background_normalized_depth)
#define BATCH 16                 // hits of a pixel handled at once, one lane each

inline float max16(const float16 v) {
    const float8 a = fmax(v.lo, v.hi);
    const float4 b = fmax(a.lo, a.hi);
    const float2 c = fmax(b.lo, b.hi);
    return fmax(c.x, c.y);
}

// What Eq. (1) needs of a batch of hits. Lanes without a hit have opacity and closeness 0, hence no weight.
typedef struct {
    float16 opacity, closeness, z;
} Hits;

inline Hits load_hits(const Camera *k, global const ulong *key, const uint count, global const uint *point_from_pair,
                      global const float *opacity, global const float *pair_closeness) {
    float o[BATCH], d[BATCH], depth[BATCH];
    for (uint j = 0; j < BATCH; j++) {
        const int hit = j < count;
        const ulong entry = key[hit ? j : 0];
        const uint pair = (uint)entry;
        o[j] = hit ? opacity[point_from_pair[pair]] : 0.0f;
        d[j] = hit ? pair_closeness[pair] : 0.0f;
        depth[j] = as_float((uint)(entry >> 32));
    }
    Hits h;
    h.opacity = vload16(0, o);
    h.closeness = vload16(0, d);
    h.z = 1.0f - (vload16(0, depth) - k->near) / (k->far - k->near);
    return h;
}

// One work-item per pixel: reads its hits, nearest first, writes their weights by pair and, with their points, by pixel.
//
// By pair: b, and b (1/o + z/gamma), finite at o = 0, whose sum with G.(f - F) is dL/do. b is negative, -0 included, where
// the pair gets no gradient: beyond the max_tracked nearest hits, or dropped.
// Dropped, with b = 0, are a hit and all behind it if even o = d = 1 would give it less than the fraction `least` of what
// lies in front. differs from Pulsar: it looks only when its buffer is flushed.
kernel __attribute__((vec_type_hint(float16))) void blend_weights(
    const uint hw,                           // pixels
    const uint max_tracked,                  // hits of a pixel that get gradients
    const float gamma,
    const float least,                       // 0: never stop
    global const float *camera,              // (20) camera.h
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pair_key,            // (P) depth << 32 | pair, sorted within a pixel
    global const uint *point_from_pair,      // (P)
    global const float *opacity,             // (N)
    global const float *pair_closeness,      // (P)
    global float2 *pair_weight,              // (P, 2)
    global ulong *hit)                       // (P) weight << 32 | point, in the order of the keys
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const Camera k = camera_load(camera);
    const uint begin = pixel_offset[q], end = pixel_offset[q + 1];
    uint stop = end;
    float M = EPS / gamma, D = 1.0f;         // the background alone
    for (uint first = begin; first < stop; first += BATCH) {
        const uint count = min((uint)BATCH, end - first);
        const Hits h = load_hits(&k, pair_key + first, count, point_from_pair, opacity, pair_closeness);
        const float16 l = log(h.opacity * h.closeness) + h.opacity * h.z / gamma;
        const float m = fmax(M, max16(l));
        float term[BATCH], best[BATCH];
        vstore16(exp(l - m), 0, term);
        vstore16(exp(fmax(h.z, 0.0f) / gamma - m), 0, best);
        D *= exp(M - m);
        M = m;
        for (uint j = 0; j < count && first + j < stop; j++) {
            if (best[j] < least / (1.0f - least) * D) stop = first + j;
            else D += term[j];
        }
    }
    for (uint first = begin; first < end; first += BATCH) {
        const uint count = min((uint)BATCH, end - first);
        const Hits h = load_hits(&k, pair_key + first, count, point_from_pair, opacity, pair_closeness);
        const float16 a = h.opacity * h.z / gamma;
        const float16 share = h.closeness * exp(fmin(a - M, 87.0f)) / D;     // b/o; a > M only where o d is tiny or 0
        float b[BATCH], slope[BATCH];
        vstore16(h.opacity * share, 0, b);
        vstore16(share * (1.0f + a), 0, slope);
        for (uint j = 0; j < count; j++) {
            const uint i = first + j, pair = (uint)pair_key[i];
            const float weight = i < stop ? b[j] : 0.0f;
            const int tracked = i < stop && i - begin < max_tracked;
            pair_weight[pair] = tracked ? (float2)(weight, slope[j]) : (float2)(-weight, 0.0f);
            hit[i] = upsample(as_uint(weight), point_from_pair[pair]);
        }
    }
}

// One work-item per pixel: reads its hits and their points' features, writes the blended features.
kernel void blend_forward(
    const uint hw,                           // pixels
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *hit,                 // (P) weight << 32 | point
    global const float16 *point_features,    // (N, 16)
    global float16 *features)                // (H, W, 16)
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    float16 sum = 0.0f;
    float weights = 0.0f;
    for (uint i = pixel_offset[q]; i < pixel_offset[q + 1]; i++) {
        const float b = as_float((uint)(hit[i] >> 32));
        sum += b * point_features[(uint)hit[i]];
        weights += b;
    }
    features[q] = sum + (1.0f - weights);    // the background's features are 1, its weight is what is left
}

// One work-item per pixel: writes G.F, the part of G.(f - F) that all its points share.
kernel void blend_backward_pixels(
    const uint hw,                           // pixels
    global const float16 *features,          // (H, W, 16) F
    global const float16 *grad_features,     // (H, W, 16) G
    global float *pixel_dot)                 // (HW)
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    pixel_dot[q] = dot16(grad_features[q], features[q]);
}

// One work-item per point: reads its pairs and their pixels' gradients, writes the gradients of its features and opacity.
kernel __attribute__((vec_type_hint(float16))) void blend_backward(
    const uint n,                            // points
    global const float16 *point_features,    // (N, 16)
    global const uint *point_offset,         // (N+1)
    global const uint *pair_pixel,           // (P)
    global const float2 *pair_weight,        // (P, 2)
    global const float16 *grad_features,     // (H, W, 16) G
    global const float *pixel_dot,           // (HW) G.F
    global float16 *grad_point_features,     // (N, 16)
    global float *grad_opacity)              // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    float16 dL_df = 0.0f;
    float dL_do = 0.0f;
    uint tracked = 0;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        const float2 weight = pair_weight[pair];
        if (signbit(weight.x)) continue;
        const uint q = pair_pixel[pair];
        const float16 G = grad_features[q];
        dL_df += weight.x * G;
        dL_do += weight.y * (dot16(G, point_features[i]) - pixel_dot[q]);
        tracked++;
    }
    const float scale = MEAN && tracked ? 1.0f / tracked : 1.0f;
    grad_point_features[i] = scale * dL_df;
    grad_opacity[i] = scale * dL_do;
}

// One work-item per point: reads what blend_backward reads, writes dL/dl and dL/dd = dL/dl / d of its pairs (see the top).
kernel void blend_backward_pairs(
    const uint n,                            // points
    global const float16 *point_features,    // (N, 16)
    global const uint *point_offset,         // (N+1)
    global const uint *pair_pixel,           // (P)
    global const float2 *pair_weight,        // (P, 2)
    global const float16 *grad_features,     // (H, W, 16) G
    global const float *pixel_dot,           // (HW) G.F
    global const float *pair_closeness,      // (P) d
    global float2 *grad_pair)                // (P, 2) dL/dl, dL/dd
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    uint tracked = 0;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++)
        tracked += !signbit(pair_weight[pair].x);
    const float scale = MEAN && tracked ? 1.0f / tracked : 1.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        const uint q = pair_pixel[pair];
        const float b = fmax(pair_weight[pair].x, 0.0f), d = pair_closeness[pair];
        const float dL_dl = scale * b * (dot16(grad_features[q], point_features[i]) - pixel_dot[q]);
        grad_pair[pair] = (float2)(dL_dl, d > 0.0f ? dL_dl / d : 0.0f);
    }
}

// One work-item per sphere: reads the gradients of its pairs, writes those of its position and radius.
kernel void blend_backward_spheres(
    const uint n,                            // spheres
    const uint k,                            // radii: 1 (all alike) or n
    const float gamma,
    global const float *camera,              // (20) camera.h
    global const float *point_radius,        // (K)
    global const float4 *point_camera,       // (N, 4) x, y, z, t
    global const float *opacity,             // (N)
    global const uint *point_offset,         // (N+1)
    global const uint *pair_pixel,           // (P)
    global const float2 *grad_pair,          // (P, 2) dL/dl, dL/dd
    global float *grad_positions,            // (N, 3) world
    global float *grad_radius)               // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const Camera view = camera_load(camera);
    const Footprint f = footprint_load(&view, point_camera[i], point_radius[k == 1 ? 0 : i]);
    const float dl_ddepth = -opacity[i] / (gamma * (view.far - view.near));
    float3 dL_dc = 0.0f;
    float dL_dR = 0.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        const uint q = pair_pixel[pair];
        const float3 ray = camera_ray(&view, q % view.width, q / view.width);
        const float3 delta = f.centre - f.t * ray;
        const float rho = length(delta);
        const float along = fmin(dot(f.centre, ray), f.t);
        const float3 across = f.centre - along * ray;
        const float w = length(across);
        const float half_chord = sqrt((f.radius + w) * fmax(f.radius - w, 0.0f));

        // depth = along - half_chord; half_chord is the constant 0 where the ray misses the sphere itself
        const float per_chord = half_chord > 0.0f ? 1.0f / half_chord : 0.0f;
        const float dL_ddepth = grad_pair[pair].x * dl_ddepth;
        dL_dc += dL_ddepth * (ray + per_chord * across);
        dL_dR -= dL_ddepth * f.radius * per_chord;

        // d = 1 - rho/R, but the constant 1 near the centre of tiny spheres; at the very centre it has no slope
        if (rho > 0.0f && !(f.tiny && rho < f.least)) {
            const float dL_dd = grad_pair[pair].y;
            dL_dc += dL_dd * (f.centre / f.t * dot(ray, delta) - delta) / (rho * f.radius);
            dL_dR += dL_dd * rho / (f.radius * f.radius);
        }
    }
    vstore3(dL_dc.x * view.right + dL_dc.y * view.down + dL_dc.z * view.forward, i, grad_positions);
    grad_radius[i] = dL_dR;
}

// One work-item per point: reads the weights of its pairs, adds their sum. Accumulates.
kernel void blend_point_weights(
    const uint n,                            // points
    global const uint *point_offset,         // (N+1)
    global const float2 *pair_weight,        // (P, 2)
    global float *point_weight)              // (N) accumulates
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    float sum = 0.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++)
        sum += fabs(pair_weight[pair].x);
    point_weight[i] += sum;
}
