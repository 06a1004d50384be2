// The blend weights of Eq. (1) of the PlenopticPoints supplemental: each pixel's softmax over its
// fragments, and which of them are dropped. Fragment i has opacity o, falloff d, and z, which is 1
// at the near sphere and 0 at the far one. Index 0 stands for the background.
//
// a_i = o_i z_i/gamma,  b_i = o_i d_i exp(a_i - M)/D,  b_0 = exp(EPS/gamma - M)/D
//
// M is the largest of EPS/gamma and the a_i where d_i > 0, D the sum of all numerators. No exponent
// is positive, and D does not vanish: a_i > 1 means o_i > gamma, and a d_i > 0 is at least 6e-8;
// without any, b_0's numerator is at least 1/e.
//
// z and the exponents are written as fma(): NVIDIA's compiler fuses products and sums at some
// places only, and equal fragments got different weights.
#include "common.h"
#include "camera.h"
#include "lanes.h"

#ifndef DERIVATIVES
#define DERIVATIVES 1  // 0: no derivatives, which only gradients need
#endif
#ifndef DROPS
#define DROPS 1  // early_stop may be above 0
#endif
#define EPS 1e-6f  // depth of the background, as a z (Pulsar's background_normalized_depth)

// What Eq. (1) needs of a batch of LANES fragments. Lanes without a fragment have opacity and
// falloff 0, hence no weight.
typedef struct {
    floats opacity, falloff, z;
} Fragments;

ALWAYS_INLINE Fragments load_fragments(
    const Camera *cam,
    global const ulong *key,
    const uint count,
    global const uint2 *pair_point_falloff,
    global const float *opacity) {
    float o[LANES] = {0.0f}, d[LANES] = {0.0f}, depth[LANES] = {0.0f};
    for (uint j = 0; j < count; j++) {
        const ulong depth_pair = key[j];
        const uint2 fragment = pair_point_falloff[(uint)depth_pair];
        o[j] = opacity[fragment.x];
        d[j] = as_float(fragment.y);
        depth[j] = as_float((uint)(depth_pair >> 32));
    }
    Fragments h;
    h.opacity = LANES_FROM(o);
    h.falloff = LANES_FROM(d);
    const floats per_depth = 1.0f / (cam->far - cam->near);
    h.z = fma(cam->near - LANES_FROM(depth), per_depth, (floats)(1.0f));
    return h;
}

// exp(a - M), where a = o z / gamma is above M by more than a rounding only where d = 0.
ALWAYS_INLINE floats exponential(const floats o_z, const float sharpness, const float M) {
    return exp(fmin(fma(o_z, (floats)(sharpness), (floats)(-M)), 0.0f));
}

// One work-item per pixel: reads its fragments, nearest first, writes their weights b with their
// points, and the derivatives s = b (1/o + z/gamma) of their weights, finite at o = 0, with which
// dL/do = s * dL/db (blend.cl), and marks these points; pixels share points, so some write the same
// 1.
//
// A fragment is dropped, with all behind it, once even an opaque, centred fragment (o = d = 1)
// would have less than the share early_stop of the weight; differs from Pulsar: it looks only when
// its buffer is flushed. One more number, without a point, then ends the pixel's list.
kernel void softmax_weights(
    const uint hw,                           // pixels
    const float sharpness,                   // 1 / gamma
    const float early_stop,                  // 0: none
    global const float *camera,              // (21) camera.h
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pair_key,            // (P) depth << 32 | pair, sorted within a pixel
    global const uint2 *pair_point_falloff,  // (P, 2) point, bits of d
    global const float *opacity,             // (N)
    global ulong *pixel_weight_point,        // (P) weight << 32 | point, in the order of the keys
    global float *pixel_derivative,          // (P, 1) alike, NULL without DERIVATIVES
    global uchar *point_is_visible)          // (N) 1: has a fragment that is not dropped
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const Camera cam = camera_load(camera);
    const uint begin = pixel_offset[q], end = pixel_offset[q + 1];
    uint stop = end;
    float M = EPS * sharpness, D = 1.0f;  // the background alone
    Fragments h;
    for (uint first = begin; first < stop; first += LANES) {
        const uint count = min((uint)LANES, end - first);
        h = load_fragments(&cam, pair_key + first, count, pair_point_falloff, opacity);
        const floats o_z = h.opacity * h.z, a = o_z * sharpness;
        const float m = fmax(M, MAX_LANES(select((floats)(M), a, h.falloff > 0.0f)));
        D *= exp(M - m);
        M = m;
        float term[LANES], best[LANES];
        LANES_INTO(term, h.opacity * h.falloff * exponential(o_z, sharpness, M));
        if (DROPS) LANES_INTO(best, exp(fma(fmax(h.z, 0.0f), (floats)(sharpness), (floats)(-M))));
        for (uint j = 0; j < count && first + j < stop; j++) {
            if (DROPS && best[j] < early_stop / (1.0f - early_stop) * D)
                stop = first + j;
            else
                D += term[j];
        }
    }
    for (uint first = begin; first < stop; first += LANES) {
        const uint count = min((uint)LANES, end - first);
        if (end - begin > LANES)
            h = load_fragments(&cam, pair_key + first, count, pair_point_falloff, opacity);
        const floats o_z = h.opacity * h.z;
        const floats share = h.falloff * exponential(o_z, sharpness, M) / D;  // b/o
        float b[LANES], derivative[LANES];
        LANES_INTO(b, h.opacity * share);
        LANES_INTO(derivative, share * (1.0f + o_z * sharpness));
        for (uint j = 0; j < min(count, stop - first); j++) {
            const uint i = first + j, point = pair_point_falloff[(uint)pair_key[i]].x;
            pixel_weight_point[i] = upsample(as_uint(b[j]), point);
            if (DERIVATIVES) pixel_derivative[i] = derivative[j];
            point_is_visible[point] = 1;
        }
    }
    if (stop < end) pixel_weight_point[stop] = NONE;
}
