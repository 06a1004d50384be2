// Features blended by the weights of alpha.cl or softmax.cl, and the backward pass, in which each
// visible point gathers the gradients of its pixels: no atomics.
//
// F = sum b_i f_i + b_0 BACKGROUND, with G = dL/dF
// dL/df_i = sum b_i G,  dL/do_i = sum s_i dL/db_i
//
// Both blends share this form; the weights b_i and their derivatives s_i by opacity are those of
// alpha.cl and softmax.cl. dL/db of a fragment is the change of the loss per unit of weight that
// moves to it from whatever would show in its place:
//
// Softmax: in its place shows the blend of all fragments, so dL/db_i = G.f_i - G.F.
//
// Alpha compositing: in its place shows what lies behind it, see alpha.cl.
//
// A kernel of each blend writes (b, s dL/db) of the fragments by pair, where each point finds its
// own; that of the softmax (b, s), and the point multiplies by dL/db. From the same rows come the
// gradients of offsets (offsets.cl).
#include "common.h"
#include "lanes.h"
#include "raster/footprint.h"
#include "reduce.h"

#ifndef DL_DB
#define DL_DB 0  // 1: pair_gradient lacks dL/db: softmax_gradient wrote it
#endif

// One work-item per part of a pixel: reads its fragments and their points' features, writes the
// blended features.
kernel void blend_forward(
    const uint hw,                           // pixels
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pixel_weight_point,  // (P) weight << 32 | point; no point: the list ends
    global const uint *point_slot,           // (N) row of a visible point
    global const float16 *visible_features,  // (?, 16) of the visible points
    global float16 *features)                // (H, W, 16)
{
    const uint q = get_global_id(0) / ROW_PARTS;
    if (q >= hw) return;
    const uint end = pixel_offset[q + 1];
    floats sum = 0.0f;
    float weights = 0.0f;
    for (uint i = pixel_offset[q]; i < end && (uint)pixel_weight_point[i] != NONE; i += BATCH) {
        float b[BATCH];
        floats feature[BATCH];
        bool listed = true;
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
            const ulong weight_point = j == 0 || i + j < end ? pixel_weight_point[i + j] : NONE;
            listed = listed && (uint)weight_point != NONE;
            b[j] = listed ? upper_float(weight_point) : 0.0f;
            feature[j] =
                listed ? load_part(visible_features, point_slot[(uint)weight_point]) : 0.0f;
        }
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
            sum += b[j] * feature[j];
            weights += b[j];
        }
        if (!listed) break;
    }
    store_part(sum + (1.0f - weights) * BACKGROUND, features, q);
}

// One work-item per part of a visible point: reads its pairs and their pixels' gradients, writes
// the gradients of its features and, the first one, of its opacity, s dL/db by pair with DL_DB, and
// the sum of its blend weights if it is the highest so far.
kernel void blend_backward(
    const uint s,                            // visible points
    const int is_recorded,                   // 0: max_weight is not touched
    global const uint *visible,              // (?) their indices, S
    global const uint *point_offset,         // (N+1)
    global const uint *pair_pixel,           // (P)
    global float *pair_gradient,             // (P, 1+SAMPLES) b, s dL/db of each; s with DL_DB
    global const float *pixel_blend,         // (HW) G.F, NULL without DL_DB
    global const float16 *visible_features,  // (?, 16) a row for each, read with CLAMPED, DL_DB
    global const float16 *grad_features,     // (H, W, 16) G
    global float16 *grad_visible_features,   // (?, 16) alike
    global float *grad_opacity,              // (?) alike
    global float *max_weight)                // (N) read and written, NULL if not is_recorded
{
    const uint g = get_global_id(0) / ROW_PARTS;
    if (g >= s) return;
    const uint i = visible[g];
    const float16 feature = DL_DB ? visible_features[g] : 0.0f;
    floats dL_df = 0.0f;
    float dL_do = 0.0f, weight = 0.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++) {
        global float *row = pair_gradient + (size_t)(1 + SAMPLES) * pair;
        const float b = row[0];
        float of_samples[SAMPLES], sum = 0.0f;
        bool is_empty = b == 0.0f;
        UNROLLED_FOR (uint k = 0; k < SAMPLES; k++) {
            of_samples[k] = row[1 + k];
            is_empty = is_empty && of_samples[k] == 0.0f;
        }
        if (is_empty) continue;  // mostly dropped
        const uint q = pair_pixel[pair];
        const floats G = load_part(grad_features, q);
        if (DL_DB && ROW_PART == 0) {
            of_samples[0] *= dot16(grad_features[q], feature) - pixel_blend[q];
            row[1] = of_samples[0];
        }
        UNROLLED_FOR (uint k = 0; k < SAMPLES; k++)
            sum += of_samples[k];
        dL_df += b * G;
        dL_do += sum;
        weight += b;
    }
    // features that shade.cl has clamped to 0 have no gradient
    if (CLAMPED) dL_df = load_part(visible_features, g) == 0.0f ? 0.0f : dL_df;
    store_part(dL_df, grad_visible_features, g);
    if (ROW_PART > 0) return;
    grad_opacity[g] = dL_do;
    // fmax() would hide a NaN
    if (is_recorded && (weight > max_weight[i] || isnan(weight))) max_weight[i] = weight;
}
