// Front-to-back alpha compositing, with opacity o, falloff d and transmittance T of the fragments
// that a sample of a pixel sees:
//
// alpha_i = o_i d_i,  b_i = T_i alpha_i,  T_(i+1) = T_i (1 - alpha_i),  T_1 = 1
//
// The background gets the transmittance T behind all fragments. An opaque fragment lets
// LEAST_THROUGH pass. A pixel has SIDE x SIDE samples, in LANES = SAMPLES lanes. They share the
// pixel's list, since the depth of a disc is its point's distance from the eye, the same for all; a
// sample that a point does not cover sees it with falloff 0. A fragment's weight is the mean of
// theirs.
//
// In place of a fragment would show what lies behind it, composited to R_i, so dL/db_i = G.f_i - B_i
// with B_i = G.R_i, and dL/dalpha_i = T_i dL/db_i. B_i is accumulated back to front, which never
// divides by 1 - alpha. A gradient g of the pixel's alpha, 1 - T, acts as one more feature that is 1
// at all points and 0 at the background: G.f becomes G.f + g. The distortion loss of the pixel, w
// sum_ij b_i b_j |z_i - z_j| (Mip-NeRF 360, Eq. 15), adds its derivative with respect to b_i to
// G.f_i in the same way, and so does the depth loss (training/depth_loss.cl).
#include "group.h"
#include "raster/samples.h"
#include "reduce.h"

#ifndef DERIVATIVES
#define DERIVATIVES 1  // 0: no derivatives, which only gradients need
#endif
#ifndef SPAN
#define SPAN 64  // pixels whose distortion loss is one sum
#endif

// The weights b of a fragment in the samples; those of several are not stored.
#if SAMPLES == 1
#define SAMPLE_WEIGHTS(i, weight_point) upper_float(weight_point)
#else
#define SAMPLE_WEIGHTS(i, weight_point)                                                            \
    (opacity[(uint)(weight_point)] * LANES_FROM(pixel_derivative + (size_t)SAMPLES * (i)))
#endif

// One work-item per pixel: reads its fragments, nearest first, writes their weights b with their
// points, and for each sample the derivative s = T d of its weight by the opacity, with which dL/do
// = s * dL/db (blend.cl), and marks these points; pixels share points, so some write the same 1.
//
// Early stop: a sample drops the fragments behind the depth where its T falls below early_stop, as
// they could weigh no more than T in all; where all samples do, one more number, without a point,
// ends the list.
kernel void alpha_weights(
    const uint hw,                          // pixels
    const float early_stop,                 // T behind which fragments are dropped; 0: none
    global const float *camera,             // (21) camera.h, of the samples
    global const float4 *point_camera,      // (N, 4) x, y, z, distance; read of several samples
    global const float *point_shape,        // (N, SHAPE) footprint.h, alike
    global const uint *pixel_offset,        // (HW+1)
    global const ulong *pair_key,           // (P) depth << 32 | pair, sorted within a pixel
    global const uint *pair_point_falloff,  // (P, ?) point, with one sample bits of d
    global const float *opacity,            // (N)
    global ulong *pixel_weight_point,       // (P) weight << 32 | point, in the order of the keys
    global float *pixel_derivative,         // (P, SAMPLES) alike, NULL without DERIVATIVES
    global float *transmittance,            // (HW) mean of those of the samples
    global float *sample_transmittance,     // (HW, SAMPLES) NULL without DERIVATIVES
    global uchar *point_is_visible)         // (N) 1: has a fragment that is not dropped
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const Camera cam = camera_load(camera);
    const Rays m = rays_of(&cam, q);
    const uint begin = pixel_offset[q], end = pixel_offset[q + 1], last = pixel_offset[hw] - 1;
    floats T = 1.0f;
    uint i = begin;
    while (i < end && ANY_LANE(T >= early_stop)) {
        const uint later = (uint)pair_key[min(i + FRAGMENTS_AHEAD, last)];
        READ_AHEAD(pair_point_falloff + (SAMPLES == 1 ? 2 : 1) * (size_t)later);
        if (SAMPLES > 1) {
            const uint soon = (uint)pair_key[min(i + POINTS_AHEAD, last)];
            READ_AHEAD(point_camera + pair_point_falloff[soon]);
        }
        Fragment fragments[BATCH];
        float o[BATCH];
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
            const uint pair = (uint)pair_key[j == 0 ? i : min(i + j, end - 1)];
            fragments[j] =
                fragment_load(pair, &cam, &m, point_camera, point_shape, pair_point_falloff);
            o[j] = opacity[fragments[j].point];
        }
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++, i++) {
            if (BATCH > 1 && (i >= end || !ANY_LANE(T >= early_stop))) break;
            const uint point = fragments[j].point;
            const floats d = fragments[j].falloff, none = 0.0f, most = MOST_ALPHA;
            floats alpha = o[j] * d;
            const ints shows = (T >= early_stop) & !(alpha < LEAST_ALPHA);
            alpha = select(none, select(alpha, most, alpha > MOST_ALPHA), shows);
            pixel_weight_point[i] = upsample(as_uint(SUM_LANES(T * alpha) / SAMPLES), point);
            if (DERIVATIVES)
                LANES_INTO(pixel_derivative + (size_t)SAMPLES * i, select(none, T * d, shows));
            point_is_visible[point] = 1;
            T = transmit(T, alpha);
        }
    }
    if (i < end) pixel_weight_point[i] = NONE;
    transmittance[q] = SUM_LANES(T) / SAMPLES;
    if (DERIVATIVES) LANES_INTO(sample_transmittance + (size_t)SAMPLES * q, T);
}

// GROUP work-items per run of SPAN pixels: read the fragments of each, farthest first, and their
// points' features, write what each of the `tracked` nearest ones adds to the gradients of its
// point (blend.cl), with those of alpha and of the distortion loss; and that loss. A sample's share
// of them is 1 / SAMPLES.
kernel void alpha_gradient(
    const uint hw,       // pixels
    const uint tracked,  // fragments of a pixel that get gradients
    const int has_grad_alpha,
    const float distortion_weight,             // of a sample; 0: none, `distortion` is not written
    global const uint *pixel_offset,           // (HW+1)
    global const ulong *pair_key,              // (P) depth << 32 | pair
    global const ulong *pixel_weight_point,    // (P) weight << 32 | point; no point: the list ends
    global const float *pixel_derivative,      // (P, SAMPLES)
    global const float *sample_transmittance,  // (HW, SAMPLES)
    global const float *opacity,               // (N) read of several samples
    global const uint *point_slot,             // (N) row of a visible point
    global const float16 *visible_features,    // (?, 16) of the visible points
    global const float16 *grad_features,       // (H, W, 16) G
    global const float *grad_alpha,            // (HW) g, NULL without has_grad_alpha
    const int has_depth,
    global const float2 *depth_gradient,  // (HW, 2) depth_loss.cl, NULL without has_depth
    global float *pair_gradient,          // (P, 1+SAMPLES) b, s dL/db of each; cleared before
    global float *distortion)             // ((HW+SPAN-1)/SPAN) of each run, without its weight
{
    SHARED(float, shared, GROUP);
    const uint last = min(hw, (GROUP_ID + 1) * SPAN);
    if (GROUP_ID * SPAN >= hw) return;
    float sum = 0.0f;
    for (uint q = GROUP_ID * SPAN + MEMBER; q < last; q += GROUP) {
        const float16 G = grad_features[q] / SAMPLES;
        const float g = has_grad_alpha ? grad_alpha[q] / SAMPLES : 0.0f;
        const float2 bend = has_depth ? depth_gradient[q] : 0.0f;
        const uint begin = pixel_offset[q];
        // depths count from here, so that sums of them keep their digits
        const float nearest = begin < pixel_offset[q + 1] ? upper_float(pair_key[begin]) : 0.0f;
        floats front = 0.0f, front_z = 0.0f, behind = 0.0f, behind_z = 0.0f;  // sums of b and b z
        uint end = begin;
        for (; end < pixel_offset[q + 1] && (uint)pixel_weight_point[end] != NONE; end++) {
            READ_AHEAD(visible_features + point_slot[(uint)pixel_weight_point[end]]);
            if (distortion_weight > 0.0f) {
                const floats b = SAMPLE_WEIGHTS(end, pixel_weight_point[end]);
                front += b;
                front_z += b * (upper_float(pair_key[end]) - nearest);
            }
        }
        floats T = LANES_FROM(sample_transmittance + (size_t)SAMPLES * q);
        floats B = dot16(G, (float16)(BACKGROUND));
        for (uint i = end; i > begin;) {
            ulong key[BATCH], weight_point[BATCH];
            float of_point[BATCH];
            floats derivative[BATCH], weight[BATCH];
            GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
                const uint at = j == 0 || i - begin > j ? i - 1 - j : begin;
                key[j] = pair_key[at];
                weight_point[j] = pixel_weight_point[at];
                derivative[j] = LANES_FROM(pixel_derivative + (size_t)SAMPLES * at);
                weight[j] = SAMPLE_WEIGHTS(at, weight_point[j]);
                of_point[j] = dot16(G, visible_features[point_slot[(uint)weight_point[j]]]);
            }
            GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
                if (BATCH > 1 && i == begin) break;
                i--;
                const floats b = weight[j];
                floats own = of_point[j];
                if (distortion_weight > 0.0f) {
                    const float z = upper_float(key[j]) - nearest;
                    front -= b;
                    front_z -= b * z;
                    const floats distances = z * (front - behind) - (front_z - behind_z);
                    own += 2.0f * distortion_weight * distances;
                    sum += SUM_LANES(b * distances);
                    behind += b;
                    behind_z += b * z;
                }
                if (has_depth) own += bend.x / SAMPLES * (upper_float(key[j]) - bend.y);
                const floats dL_db = own + g - B;
                if (i - begin < tracked) {
                    global float *row = pair_gradient + (size_t)(1 + SAMPLES) * (uint)key[j];
                    row[0] = upper_float(weight_point[j]);
                    LANES_INTO(row + 1, derivative[j] * dL_db);
                }
                T += b;  // in front of this fragment
                B += select((floats)(0.0f), b / T * dL_db, b > 0.0f);
            }
        }
    }
    sum = group_sum(sum, shared);
    if (distortion_weight > 0.0f && MEMBER == 0) distortion[GROUP_ID] = sum;
}
