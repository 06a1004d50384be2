// Features blended by the weights of alpha.cl or softmax.cl, and the backward pass, in which each
// visible point gathers the gradients of its pixels: no atomics.
//
// F = sum b_i f_i + b_0 BACKGROUND, with G = dL/dF
// dL/df_i = sum b_i G,  dL/do_i = sum s_i gain_i
//
// Both blends share this form; the weights b_i and slopes s_i are those of alpha.cl and softmax.cl.
// The gain of a hit is the change of the loss per unit of weight that moves to it from whatever would
// show in its place:
//
// Softmax: in its place shows the blend of all hits, so gain_i = G.f_i - G.F.
//
// Alpha compositing: in its place shows what lies behind it, composited to R_i, so gain_i = G.f_i -
// B_i with B_i = G.R_i, and dL/dalpha_i = T_i gain_i. B_i is accumulated back to front, which never
// divides by 1 - alpha. A gradient g of the pixel's alpha, 1 - T, acts as one more feature that is
// 1 at all points and 0 at the background: G.f becomes G.f + g. The spread of the pixel, w sum_ij
// b_i b_j |z_i - z_j| (the distortion loss of Mip-NeRF 360, Eq. 15), adds its derivative with
// respect to b_i to G.f_i in the same way.
//
// A kernel of each blend writes (b, s gain) of the hits by pair, where each point finds its own; that
// of the softmax (b, s), and the point adds the gain.
#include "common.h"
#include "lanes.h"
#include "raster/footprint.h"
#include "reduce.h"

#ifndef GAINS
#define GAINS 0  // 1: pair_gradient has no gains yet: softmax_gradient wrote it
#endif

// The depth of a key, the weight of an entry.
static inline float upper_float(const ulong word) {
    return as_float((uint)(word >> 32));
}

// One work-item per part of a pixel: reads its hits and their points' features, writes the blended
// features.
kernel void blend_forward(
    const uint hw,                          // pixels
    global const uint *pixel_offset,        // (HW+1)
    global const ulong *pixel_entry,        // (P) weight << 32 | point; no point: the list ends
    global const uint *point_slot,          // (N) row of a visible point
    global const float16 *shaded_features,  // (?, 16) of the visible points
    global float16 *features)               // (H, W, 16)
{
    const uint q = get_global_id(0) / ROW_PARTS;
    if (q >= hw) return;
    floats sum = 0.0f;
    float weights = 0.0f;
    const uint end = pixel_offset[q + 1];
    for (uint i = pixel_offset[q]; i < end && (uint)pixel_entry[i] != NONE; i += BATCH) {
        float b[BATCH];
        floats feature[BATCH];
        bool listed = true;
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
            const ulong entry = j == 0 || i + j < end ? pixel_entry[i + j] : NONE;
            listed = listed && (uint)entry != NONE;
            b[j] = listed ? upper_float(entry) : 0.0f;
            feature[j] = listed ? load_part(shaded_features, point_slot[(uint)entry]) : 0.0f;
        }
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
            sum += b[j] * feature[j];
            weights += b[j];
        }
        if (!listed) break;
    }
    store_part(sum + (1.0f - weights) * BACKGROUND, features, q);
}

// One work-item per pixel: reads its `tracked` nearest hits, writes the weight and the slope of each
// by pair, and G.F. Each point has its own features at hand where it gathers its pairs, so that
// they are read once a point and not once a hit.
kernel void softmax_gradient(
    const uint hw,                        // pixels
    const uint tracked,                   // hits of a pixel that get gradients
    global const uint *pixel_offset,      // (HW+1)
    global const ulong *pair_key,         // (P) depth << 32 | pair
    global const ulong *pixel_entry,      // (P) weight << 32 | point; no point: the list ends
    global const float *pixel_slope,      // (P)
    global const float16 *features,       // (H, W, 16) F
    global const float16 *grad_features,  // (H, W, 16) G
    global float2 *pair_gradient,         // (P, 2) b, s; cleared before
    global float *pixel_blend)            // (HW) G.F
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const uint begin = pixel_offset[q], end = begin + min(pixel_offset[q + 1] - begin, tracked);
    for (uint i = begin; i < end && (uint)pixel_entry[i] != NONE; i++)
        pair_gradient[(uint)pair_key[i]] = (float2)(upper_float(pixel_entry[i]), pixel_slope[i]);
    pixel_blend[q] = dot16(grad_features[q], features[q]);
}

// One work-item per pixel: reads its hits, farthest first, and their points' features, writes what
// each of the `tracked` nearest ones adds to the gradients of its point, by alpha compositing, with
// those of alpha and of the spread; and the spread.
kernel void alpha_gradient(
    const uint hw,       // pixels
    const uint tracked,  // hits of a pixel that get gradients
    const int has_grad_alpha,
    const float spread_weight,              // 0: none, and pixel_spread is not written
    global const uint *pixel_offset,        // (HW+1)
    global const ulong *pair_key,           // (P) depth << 32 | pair
    global const ulong *pixel_entry,        // (P) weight << 32 | point; no point: the list ends
    global const float *pixel_slope,        // (P)
    global const float *transmittance,      // (HW)
    global const uint *point_slot,          // (N) row of a visible point
    global const float16 *shaded_features,  // (?, 16) of the visible points
    global const float16 *grad_features,    // (H, W, 16) G
    global const float *grad_alpha,         // (HW) g, not read without has_grad_alpha
    global float2 *pair_gradient,           // (P, 2) b, s gain; cleared before
    global float *pixel_spread)             // (HW) without its weight
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const float16 G = grad_features[q];
    const float g = has_grad_alpha ? grad_alpha[q] : 0.0f;
    const uint begin = pixel_offset[q];
    // depths count from here, so that sums of them keep their digits
    const float nearest = begin < pixel_offset[q + 1] ? upper_float(pair_key[begin]) : 0.0f;
    float2 front = 0.0f, behind = 0.0f;  // sums of b and b z of the hits there
    uint end = begin;
    for (; end < pixel_offset[q + 1] && (uint)pixel_entry[end] != NONE; end++) {
        READ_AHEAD(shaded_features + point_slot[(uint)pixel_entry[end]]);
        if (spread_weight > 0.0f) {
            const float z = upper_float(pair_key[end]) - nearest;
            front += upper_float(pixel_entry[end]) * (float2)(1.0f, z);
        }
    }
    float T = transmittance[q], spread = 0.0f;
    float B = dot16(G, (float16)(BACKGROUND));
    for (uint i = end; i > begin;) {
        ulong key[BATCH];
        float weight[BATCH], slope[BATCH], of_point[BATCH];
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
            const uint at = i - begin > j ? i - 1 - j : begin;
            const ulong entry = pixel_entry[at];
            key[j] = pair_key[at];
            weight[j] = upper_float(entry);
            slope[j] = pixel_slope[at];
            of_point[j] = dot16(G, shaded_features[point_slot[(uint)entry]]);
        }
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH && i > begin; j++) {
            i--;
            const float b = weight[j];
            float own = of_point[j];
            if (spread_weight > 0.0f) {
                const float z = upper_float(key[j]) - nearest;
                front -= b * (float2)(1.0f, z);
                const float distances = z * (front.x - behind.x) - (front.y - behind.y);
                own += 2.0f * spread_weight * distances;
                spread += b * distances;
                behind += b * (float2)(1.0f, z);
            }
            const float gain = own + g - B;
            if (i - begin < tracked) pair_gradient[(uint)key[j]] = (float2)(b, slope[j] * gain);
            if (b > 0.0f) {
                T += b;  // in front of this hit
                B += b / T * gain;
            }
        }
    }
    if (spread_weight > 0.0f) pixel_spread[q] = spread;
}

// One work-item per part of a visible point: reads its pairs and their pixels' gradients, writes
// the gradients of its features and, the first one, of its opacity, and gains where GAINS.
kernel void blend_backward(
    const uint s,                           // visible points
    global const uint *shaded,              // (S) their indices
    global const uint *point_offset,        // (N+1)
    global const uint *pair_pixel,          // (P)
    global float2 *pair_gradient,           // (P, 2) b, s gain; s is read with GAINS
    global const float *pixel_blend,        // (?) (HW) G.F, read with GAINS
    global const float16 *shaded_features,  // (?, 16) a row for each, read with CLAMPED, GAINS
    global const float16 *grad_features,    // (H, W, 16) G
    global float16 *grad_shaded_features,   // (?, 16) alike
    global float *grad_opacity)             // (?) alike
{
    const uint g = get_global_id(0) / ROW_PARTS;
    if (g >= s) return;
    const uint i = shaded[g];
    const float16 feature = GAINS ? shaded_features[g] : 0.0f;
    floats dL_df = 0.0f;
    float dL_do = 0.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        float2 of_hit = pair_gradient[pair];
        if (of_hit.x == 0.0f && of_hit.y == 0.0f) continue;  // mostly dropped
        const uint q = pair_pixel[pair];
        const floats G = load_part(grad_features, q);
        if (GAINS && ROW_PART == 0) {
            of_hit.y *= dot16(grad_features[q], feature) - pixel_blend[q];
            pair_gradient[pair].y = of_hit.y;
        }
        dL_df += of_hit.x * G;
        dL_do += of_hit.y;
    }
    // features that shade.cl has clamped to 0 have no gradient
    if (CLAMPED) dL_df = load_part(shaded_features, g) == 0.0f ? 0.0f : dL_df;
    store_part(dL_df, grad_shaded_features, g);
    if (ROW_PART == 0) grad_opacity[g] = dL_do;
}
