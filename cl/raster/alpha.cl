// The blend weights of front-to-back alpha compositing, with opacity o, falloff d and
// transmittance T of the fragments of a pixel:
//
// alpha_i = o_i d_i,  b_i = T_i alpha_i,  T_(i+1) = T_i (1 - alpha_i),  T_1 = 1
//
// The background gets the transmittance T behind all fragments. An opaque fragment lets
// LEAST_THROUGH pass.
#include "common.h"
#include "lanes.h"
#include "raster/footprint.h"

#ifndef DERIVATIVES
#define DERIVATIVES 1  // 0: no derivatives, which only gradients need
#endif

// One work-item per pixel: reads its fragments, nearest first, writes their weights b with their
// points, and the derivatives s = T d of the weights by the opacities, with which dL/do = s * dL/db
// (blend.cl), and marks these points; pixels share points, so some write the same 1.
//
// Early stop: a pixel drops the fragments behind the depth where T falls below early_stop, as they
// could weigh no more than T in all; one more number, without a point, then ends its list.
kernel void alpha_weights(
    const uint hw,                           // pixels
    const float early_stop,                  // T behind which fragments are dropped; 0: none
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pair_key,            // (P) depth << 32 | pair, sorted within a pixel
    global const uint2 *pair_point_falloff,  // (P, 2) point, bits of d
    global const float *opacity,             // (N)
    global ulong *pixel_weight_point,        // (P) weight << 32 | point, in the order of the keys
    global float *pixel_derivative,          // (P) alike, NULL without DERIVATIVES
    global float *transmittance,             // (HW) of all fragments that are not dropped
    global uchar *point_is_visible)          // (N) 1: has a fragment that is not dropped
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const uint begin = pixel_offset[q], end = pixel_offset[q + 1];
    float T = 1.0f;
    uint i = begin;
    while (i < end && T >= early_stop) {
        READ_AHEAD(
            pair_point_falloff + (uint)pair_key[min(i + FRAGMENTS_AHEAD, pixel_offset[hw] - 1)]);
        uint2 fragments[BATCH];
        float o[BATCH];
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH; j++) {
            fragments[j] = pair_point_falloff[(uint)pair_key[j == 0 ? i : min(i + j, end - 1)]];
            o[j] = opacity[fragments[j].x];
        }
        GPU_UNROLLED_FOR (uint j = 0; j < BATCH && i < end && T >= early_stop; j++, i++) {
            const uint2 fragment = fragments[j];
            const float d = as_float(fragment.y);
            float alpha = o[j] * d;
            const bool shows = !(alpha < LEAST_ALPHA);
            alpha = !shows ? 0.0f : alpha > MOST_ALPHA ? MOST_ALPHA : alpha;
            pixel_weight_point[i] = upsample(as_uint(T * alpha), fragment.x);
            if (DERIVATIVES) pixel_derivative[i] = shows ? T * d : 0.0f;
            point_is_visible[fragment.x] = 1;
            const float through = 1.0f - alpha;
            T *= through < LEAST_THROUGH ? LEAST_THROUGH : through;  // fmax() would hide a NaN
        }
    }
    if (i < end) pixel_weight_point[i] = NONE;
    transmittance[q] = T;
}
