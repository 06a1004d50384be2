// Front-to-back alpha compositing of a pixel's hits, and what its gradients need.
//
// alpha_i = o_i d_i,  b_i = T_i alpha_i,  T_(i+1) = T_i (1 - alpha_i),  T_1 = 1
//
// The background gets the transmittance T that is left. With B_i, the product of G = dL/dF and the
// features composited of all that lies behind hit i, dL/do_i = T_i d_i (G.f_i - B_i): nothing is
// divided by 1 - alpha. An opaque hit lets LEAST_THROUGH pass, so that B is known behind it too. A
// gradient g of the pixel's alpha, 1 - T, is that of a feature which all points have and the
// background has not: G.f becomes G.f + g. The spread of the pixel, w sum_ij b_i b_j |z_i - z_j|
// (Mip-NeRF 360, Eq. 15, its distortion), adds its derivative with respect to b_i in the same way.
#include "common.h"
#include "raster/pair_role.h"
#include "reduce.h"

#ifndef DROPS
#define DROPS 1  // hits may be dropped; their roles are DROPPED before alpha_weights
#endif
#ifndef MAX_TRACKED
#define MAX_TRACKED 0  // nearest hits of a pixel that get gradients; 0: all
#endif
#ifndef HAS_GRAD_ALPHA
#define HAS_GRAD_ALPHA 0  // 0: grad_alpha is 0 and not read
#endif
#define HAS_ROLES                                                                                  \
    (DROPS || MAX_TRACKED)  // else every pair is TRACKED, and pair_role is not touched

#define LEAST_THROUGH 0x1p-24f  // of 1 - alpha, far below what an image shows

// One work-item per pixel: reads its hits, nearest first, writes their weights by pair and, with
// their points, by pixel.
//
// By pair: b, and T d, whose product with G.f - B is dL/do. A pixel drops the hits behind the
// depth where T falls below `least`, as they could weigh no more than T in all; one more entry
// follows, with no point.
kernel void alpha_weights(
    const uint hw,                             // pixels
    const float least,                         // T behind which hits are dropped; 0: none
    global const uint *pixel_offset,           // (HW+1)
    global const ulong *pair_key,              // (P) depth << 32 | pair, sorted within a pixel
    global const uint2 *pair_point_closeness,  // (P, 2) point, bits of d
    global const float *opacity,               // (N)
    global float2 *pair_weight,                // (P, 2) not written where dropped
    global uchar *pair_role,                   // (?) P with HAS_ROLES, not written where dropped
    global ulong *pixel_entry,                 // (P) weight << 32 | point, in the order of the keys
    global float *transmittance)               // (HW) of all hits that are not dropped
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const uint begin = pixel_offset[q], end = pixel_offset[q + 1];
    float T = 1.0f;
    uint i = begin;
    for (; i < end && T >= least; i++) {
        const uint pair = (uint)pair_key[i];
        const uint2 hit = pair_point_closeness[pair];
        const float d = as_float(hit.y), alpha = opacity[hit.x] * d;
        const bool tracked = !MAX_TRACKED || i - begin < MAX_TRACKED;
        pair_weight[pair] = (float2)(T * alpha, tracked ? T * d : 0.0f);
        if (HAS_ROLES) pair_role[pair] = tracked ? TRACKED : UNTRACKED;
        pixel_entry[i] = upsample(as_uint(T * alpha), hit.x);
        T *= fmax(1.0f - alpha, LEAST_THROUGH);
    }
    if (i < end) pixel_entry[i] = NONE;
    transmittance[q] = T;
}

// The depth of a key, the weight of an entry.
static inline float upper_float(const ulong word) {
    return as_float((uint)(word >> 32));
}

// One work-item per pixel: reads its hits, farthest first, and their points' features, writes G.f +
// g - B, with what the spread adds, of each pair that is not dropped.
kernel __attribute__((vec_type_hint(float16))) void alpha_gain(
    const uint hw,                         // pixels
    const float spread_weight,             // w, 0: none
    global const uint *pixel_offset,       // (HW+1)
    global const ulong *pair_key,          // (P) depth << 32 | pair
    global const ulong *pixel_entry,       // (P) weight << 32 | point; no point: the list ends
    global const float *transmittance,     // (HW)
    global const float16 *point_features,  // (N, 16)
    global const float16 *grad_features,   // (H, W, 16) G
    global const float *grad_alpha,        // (?) HW with HAS_GRAD_ALPHA: g
    global float *gain)                    // (P)
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const float16 G = grad_features[q];
    const float g = HAS_GRAD_ALPHA ? grad_alpha[q] : 0.0f;
    const uint begin = pixel_offset[q];
    // depths count from here, so that sums of them keep their digits
    const float nearest = begin < pixel_offset[q + 1] ? upper_float(pair_key[begin]) : 0.0f;
    float2 front = 0.0f, behind = 0.0f;  // sums of b and b z of the hits there
    uint end = begin;
    for (; end < pixel_offset[q + 1] && (uint)pixel_entry[end] != NONE; end++)
        if (spread_weight > 0.0f) {
            const float z = upper_float(pair_key[end]) - nearest;
            front += upper_float(pixel_entry[end]) * (float2)(1.0f, z);
        }
    float T = transmittance[q];
    float B = dot16(G, (float16)(1.0f));  // the background's features are 1
    for (uint i = end; i-- > begin;) {
        const float b = upper_float(pixel_entry[i]);
        float own = dot16(G, point_features[(uint)pixel_entry[i]]);
        if (spread_weight > 0.0f) {
            const float z = upper_float(pair_key[i]) - nearest;
            front -= b * (float2)(1.0f, z);
            own += 2.0f * spread_weight * (z * (front.x - behind.x) - (front.y - behind.y));
            behind += b * (float2)(1.0f, z);
        }
        const float more = own + g - B;
        gain[(uint)pair_key[i]] = more;
        if (b > 0.0f) {
            T += b;  // in front of this hit
            B += b / T * more;
        }
    }
}
