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
