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
// Alpha compositing: in its place shows what lies behind it, composited to R_i, so dL/db_i = G.f_i
// - B_i with B_i = G.R_i, and dL/dalpha_i = T_i dL/db_i. B_i is accumulated back to front, which
// never divides by 1 - alpha. A gradient g of the pixel's alpha, 1 - T, acts as one more feature
// that is 1 at all points and 0 at the background: G.f becomes G.f + g. The distortion loss of the
// pixel, w sum_ij b_i b_j |z_i - z_j| (Mip-NeRF 360, Eq. 15), adds its derivative with respect to
// b_i to G.f_i in the same way, and so does the depth loss (training/depth_loss.cl).
//
// Offsets of points composited by alpha learn by the falloff d of their fragments, of which each
// kind of point that has them has the derivatives in its header: dL/dd = o/d dL/do. How the order of
// fragments and the harmonics change is left out.
//
// A kernel of each blend writes (b, s dL/db) of the fragments by pair, where each point finds its
// own; that of the softmax (b, s), and the point multiplies by dL/db.
#include "common.h"
#include "group.h"
#include "lanes.h"
#include "raster/footprint.h"
#include "reduce.h"

#ifndef MOVES
#define MOVES 0  // 1: the points' offsets have gradients
#endif
#ifndef SPAN
#define SPAN 64  // pixels whose distortion loss is one sum
#endif
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

// GROUP work-items per run of SPAN pixels: read the fragments of each, farthest first, and their
// points' features, write what each of the `tracked` nearest ones adds to the gradients of its
// point, by alpha compositing, with those of alpha and of the distortion loss; and that loss.
kernel void alpha_gradient(
    const uint hw,       // pixels
    const uint tracked,  // fragments of a pixel that get gradients
    const int has_grad_alpha,
    const float distortion_weight,           // 0: none, and `distortion` is not written
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pair_key,            // (P) depth << 32 | pair
    global const ulong *pixel_weight_point,  // (P) weight << 32 | point; no point: the list ends
    global const float *pixel_derivative,    // (P)
    global const float *transmittance,       // (HW)
    global const uint *point_slot,           // (N) row of a visible point
    global const float16 *visible_features,  // (?, 16) of the visible points
    global const float16 *grad_features,     // (H, W, 16) G
    global const float *grad_alpha,          // (HW) g, NULL without has_grad_alpha
    const int has_depth,
    global const float2 *depth_gradient,  // (HW, 2) depth_loss.cl, NULL without has_depth
    global float2 *pair_gradient,         // (P, 2) b, s dL/db; cleared before
    global float *distortion)             // ((HW+SPAN-1)/SPAN) of each run, without its weight
{
    SHARED(float, shared, GROUP);
    const uint last = min(hw, (GROUP_ID + 1) * SPAN);
    if (GROUP_ID * SPAN >= hw) return;
    float sum = 0.0f;
    for (uint q = GROUP_ID * SPAN + MEMBER; q < last; q += GROUP) {
        const float16 G = grad_features[q];
        const float g = has_grad_alpha ? grad_alpha[q] : 0.0f;
        const float2 bend = has_depth ? depth_gradient[q] : 0.0f;
        const uint begin = pixel_offset[q];
        // depths count from here, so that sums of them keep their digits
        const float nearest = begin < pixel_offset[q + 1] ? upper_float(pair_key[begin]) : 0.0f;
        float2 front = 0.0f, behind = 0.0f;  // sums of b and b z of the fragments there
        uint end = begin;
        for (; end < pixel_offset[q + 1] && (uint)pixel_weight_point[end] != NONE; end++) {
            READ_AHEAD(visible_features + point_slot[(uint)pixel_weight_point[end]]);
            if (distortion_weight > 0.0f) {
                const float z = upper_float(pair_key[end]) - nearest;
                front += upper_float(pixel_weight_point[end]) * (float2)(1.0f, z);
            }
        }
        float T = transmittance[q];
        float B = dot16(G, (float16)(BACKGROUND));
        for (uint i = end; i > begin;) {
            ulong key[BATCH];
            float weight[BATCH], derivative[BATCH], of_point[BATCH];
            GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
                const uint at = i - begin > j ? i - 1 - j : begin;
                const ulong weight_point = pixel_weight_point[at];
                key[j] = pair_key[at];
                weight[j] = upper_float(weight_point);
                derivative[j] = pixel_derivative[at];
                of_point[j] = dot16(G, visible_features[point_slot[(uint)weight_point]]);
            }
            GPU_UNROLLED_FOR (uint j = 0; j < BATCH && i > begin; j++) {
                i--;
                const float b = weight[j];
                float own = of_point[j];
                if (distortion_weight > 0.0f) {
                    const float z = upper_float(key[j]) - nearest;
                    front -= b * (float2)(1.0f, z);
                    const float distances = z * (front.x - behind.x) - (front.y - behind.y);
                    own += 2.0f * distortion_weight * distances;
                    sum += b * distances;
                    behind += b * (float2)(1.0f, z);
                }
                if (has_depth) own += bend.x * (upper_float(key[j]) - bend.y);
                const float dL_db = own + g - B;
                if (i - begin < tracked)
                    pair_gradient[(uint)key[j]] = (float2)(b, derivative[j] * dL_db);
                if (b > 0.0f) {
                    T += b;  // in front of this fragment
                    B += b / T * dL_db;
                }
            }
        }
    }
    sum = group_sum(sum, shared);
    if (distortion_weight > 0.0f && MEMBER == 0) distortion[GROUP_ID] = sum;
}

// One work-item per part of a visible point: reads its pairs and their pixels' gradients, writes
// the gradients of its features and, the first one, of its opacity, s dL/db by pair with DL_DB, with
// MOVES the gradient of its offset, in edges of the grid and as cloud.h has it, and the sum of its
// blend weights if it is the highest so far.
kernel void blend_backward(
    const uint s,                            // visible points
    const float voxel_size,                  // of the grid, world units
    const float radius,                      // of a point without offsets, world units
    const int is_recorded,                   // 0: max_weight is not touched
    global const uint *visible,              // (?) their indices, S
    global const float *camera,              // (21) camera.h, read with MOVES, as the next five
    global const float4 *point_camera,       // (N, 4) x, y, z, distance
    global const float *point_shape,         // (N, SHAPE) footprint.h
    global const float *cloud_offset,        // (N, OFFSETS) read of Gaussians, else may be NULL
    global const float *opacity,             // (N)
    global const uint *pair_point_falloff,   // (P, ?) point, with one sample bits of d
    global const uint *point_offset,         // (N+1)
    global const uint *pair_pixel,           // (P)
    global float *pair_gradient,             // (P, 1+SAMPLES) b, s dL/db of each; s with DL_DB
    global const float *pixel_blend,         // (HW) G.F, NULL without DL_DB
    global const float16 *visible_features,  // (?, 16) a row for each, read with CLAMPED, DL_DB
    global const float16 *grad_features,     // (H, W, 16) G
    global float16 *grad_visible_features,   // (?, 16) alike
    global float *grad_opacity,              // (?) alike
    global float *grad_offset,               // (?, OFFSETS) alike, NULL without MOVES
    global float *max_weight)                // (N) read and written, NULL if not is_recorded
{
    const uint g = get_global_id(0) / ROW_PARTS;
    if (g >= s) return;
    const uint i = visible[g];
#if MOVES
    const Camera cam = camera_load(camera);
    OffsetGradient moved = offset_begin(&cam, point_camera[i], point_shape + (size_t)SHAPE * i);
#endif
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
#if MOVES
        const float d = as_float(pair_point_falloff[2 * pair + 1]);  // 0 at the very rim
        if (ROW_PART == 0 && d > 0.0f && sum != 0.0f)
            offset_add(&moved, &cam, q, d, opacity[i] * sum / d);
#endif
    }
    // features that shade.cl has clamped to 0 have no gradient
    if (CLAMPED) dL_df = load_part(visible_features, g) == 0.0f ? 0.0f : dL_df;
    store_part(dL_df, grad_visible_features, g);
    if (ROW_PART > 0) return;
    grad_opacity[g] = dL_do;
    // fmax() would hide a NaN
    if (is_recorded && (weight > max_weight[i] || isnan(weight))) max_weight[i] = weight;
#if MOVES
    const Offsets offset = FORM > 1 ? OFFSETS_AT(cloud_offset, i) : (Offsets)(0.0f);
    OFFSETS_AT(grad_offset, g) = offset_end(&moved, &cam, voxel_size, radius, offset);
#endif
}
