// Front-to-back alpha compositing of several samples a pixel, SIDE x SIDE of them in a grid, in LANES
// = SAMPLES lanes: what alpha.cl and blend.cl do for one. All samples share the pixel's list, since
// the depth of a disc is its point's distance from the eye, the same for all. A sample that a point
// does not cover sees it with falloff 0. A fragment's weight is the mean of the samples'.
#include "group.h"
#include "raster/samples.h"
#include "reduce.h"

#ifndef DERIVATIVES
#define DERIVATIVES 1  // 0: no derivatives, which only gradients need
#endif
#ifndef SPAN
#define SPAN 64  // pixels whose distortion loss is one sum
#endif

// One work-item per pixel: reads its fragments, nearest first, writes their mean weights with their
// points, and for each sample the derivative s = T d of its weight b = o s by the opacity, and marks
// these points. A sample drops the fragments behind the depth where its T falls below early_stop;
// where all do, one more number, without a point, ends the list.
kernel void sampled_weights(
    const uint hw,                       // pixels
    const float early_stop,              // T behind which fragments are dropped; 0: none
    global const float *camera,          // (21) camera.h, of the samples
    global const float4 *point_camera,   // (N, 4) x, y, z, distance
    global const float *point_shape,     // (N, SHAPE) footprint.h
    global const uint *pixel_offset,     // (HW+1)
    global const ulong *pair_key,        // (P) depth << 32 | pair, sorted within a pixel
    global const uint *pair_point,       // (P, 1)
    global const float *opacity,         // (N)
    global ulong *pixel_weight_point,    // (P) weight << 32 | point, in the order of the keys
    global float *sample_derivative,     // (P, SAMPLES) alike, NULL without DERIVATIVES
    global float *transmittance,         // (HW) mean of those of the samples
    global float *sample_transmittance,  // (HW, SAMPLES) NULL without DERIVATIVES
    global uchar *point_is_visible)      // (N) 1: has a fragment that is not dropped
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const Camera cam = camera_load(camera);
    const Rays m = rays_of(&cam, q);
    const uint begin = pixel_offset[q], end = pixel_offset[q + 1], last = pixel_offset[hw] - 1;
    floats T = 1.0f;
    uint i = begin;
    for (; i < end && ANY_LANE(T >= early_stop); i++) {
        READ_AHEAD(pair_point + (uint)pair_key[min(i + FRAGMENTS_AHEAD, last)]);
        READ_AHEAD(point_camera + pair_point[(uint)pair_key[min(i + POINTS_AHEAD, last)]]);
        const uint point = pair_point[(uint)pair_key[i]];
        const float4 centre = point_camera[point];
        const floats d = falloffs(&m, centre, reach_of(&cam, centre, point_shape, point));
        const floats s = select((floats)(0.0f), T * d, T >= early_stop);
        const floats b = opacity[point] * s;
        pixel_weight_point[i] = upsample(as_uint(SUM_LANES(b) / SAMPLES), point);
        if (DERIVATIVES) LANES_INTO(sample_derivative + (size_t)SAMPLES * i, s);
        point_is_visible[point] = 1;
        const floats through = select((floats)(1.0f), 1.0f - opacity[point] * d, T >= early_stop);
        T *= select(through, (floats)(LEAST_THROUGH), through < LEAST_THROUGH);
    }
    if (i < end) pixel_weight_point[i] = NONE;
    transmittance[q] = SUM_LANES(T) / SAMPLES;
    if (DERIVATIVES) LANES_INTO(sample_transmittance + (size_t)SAMPLES * q, T);
}

// GROUP work-items per run of SPAN pixels: what alpha_gradient in blend.cl does, with B, T and the
// distortion loss of each sample, whose share of the pixel is 1 / SAMPLES.
kernel void sampled_gradient(
    const uint hw,       // pixels
    const uint tracked,  // fragments of a pixel that get gradients
    const int has_grad_alpha,
    const float distortion_weight,             // of a sample; 0: none, `distortion` is not written
    global const uint *pixel_offset,           // (HW+1)
    global const ulong *pair_key,              // (P) depth << 32 | pair
    global const ulong *pixel_weight_point,    // (P) weight << 32 | point; no point: the list ends
    global const float *sample_derivative,     // (P, SAMPLES)
    global const float *sample_transmittance,  // (HW, SAMPLES)
    global const float *opacity,               // (N)
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
                const floats b = opacity[(uint)pixel_weight_point[end]] *
                                 LANES_FROM(sample_derivative + (size_t)SAMPLES * end);
                front += b;
                front_z += b * (upper_float(pair_key[end]) - nearest);
            }
        }
        floats T = LANES_FROM(sample_transmittance + (size_t)SAMPLES * q);
        floats B = dot16(G, (float16)(BACKGROUND));
        for (uint i = end; i-- > begin;) {
            const ulong key = pair_key[i], weight_point = pixel_weight_point[i];
            const floats s = LANES_FROM(sample_derivative + (size_t)SAMPLES * i);
            const floats b = opacity[(uint)weight_point] * s;
            floats own = dot16(G, visible_features[point_slot[(uint)weight_point]]);
            if (distortion_weight > 0.0f) {
                const float z = upper_float(key) - nearest;
                front -= b;
                front_z -= b * z;
                const floats distances = z * (front - behind) - (front_z - behind_z);
                own += 2.0f * distortion_weight * distances;
                sum += SUM_LANES(b * distances);
                behind += b;
                behind_z += b * z;
            }
            if (has_depth) own += bend.x / SAMPLES * (upper_float(key) - bend.y);
            const floats dL_db = own + g - B;
            if (i - begin < tracked) {
                global float *row = pair_gradient + (size_t)(1 + SAMPLES) * (uint)key;
                row[0] = upper_float(weight_point);
                LANES_INTO(row + 1, s * dL_db);
            }
            T += b;  // in front of this fragment
            B += select((floats)(0.0f), b / T * dL_db, b > 0.0f);
        }
    }
    sum = group_sum(sum, shared);
    if (distortion_weight > 0.0f && MEMBER == 0) distortion[GROUP_ID] = sum;
}
