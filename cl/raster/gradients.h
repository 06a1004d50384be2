// What the way back of blend.cl keeps of a tile's pixels, and how it sums what they add to the gradients
// of a point: on CPUs in a work-item, on GPUs in a work-group (gpu/gradients.h).
#ifndef PP_GRADIENTS_H
#define PP_GRADIENTS_H

#include "raster/compositing.h"

#ifndef MOVED
#define MOVED MOVES  // 1: gradients of offsets, too
#endif
#include "raster/sums.h"

#if GROUP > 1
#include "gpu/gradients.h"
#else

#define PART_BLOCKS SAMPLES  // have 16 pixels
#define PARTS (BLOCKS / PART_BLOCKS)

// The gradients of the pixels, of each sample's share: those of features, and the loss's derivatives
// by alpha and, with the mean range, by range.
typedef struct {
    float16 of_features[BLOCKS * BLOCK_PIXELS];
    float16 of_channel[CHANNELS * PARTS];  // the same: 16 pixels by channel
    float16 of_alpha[PARTS], of_range[PARTS], mean[PARTS];
} PixelGradients;

// Of one point: G.f in each pixel, and the sums for its features.
typedef struct {
    float of_pixels[BLOCKS * BLOCK_PIXELS];
    float16 of_features, of_others;
} PairGradients;

#define SHARED_SUMS
#define FEATURE_ROW(entry) ((global const float *)(visible_features + point_slot[(uint)(entry)]))

// G.f of 16 pixels at a time, of those parts of the tile that have any of the blocks.
#define PAIR_BEGIN(g, f, blocks, range) pair_begin(g, f, blocks, range)
ALWAYS_INLINE PairGradients
pair_begin(const PixelGradients *g, global const float *f, const uint blocks, const float range) {
    PairGradients pair;
    pair.of_features = pair.of_others = 0.0f;
    for (uint left = blocks; left;) {
        const uint part = (31 - clz(left & -left)) / PART_BLOCKS;
        left &= ~(((1u << PART_BLOCKS) - 1) << part * PART_BLOCKS);
        float16 one = g->of_alpha[part] + g->of_range[part] * (range - g->mean[part]), other = 0.0f;
        UNROLLED_FOR (uint c = 0; c < CHANNELS; c += 2) {
            one += f[c] * g->of_channel[CHANNELS * part + c];
            other += f[c + 1] * g->of_channel[CHANNELS * part + c + 1];
        }
        vstore16(one + other, part, pair.of_pixels);
    }
    return pair;
}

// Values of the pixels of a block, for each sample.
ALWAYS_INLINE float16 by_sample(const float *of_pixels) {
#if SAMPLES == 4
    const float4 once = vload4(0, of_pixels);
    return (float16)(once, once, once, once);
#else
    return vload16(0, of_pixels);
#endif
}

// dL/db of a block's samples, but for what shows in place of the point.
ALWAYS_INLINE float16
of_samples(const PairGradients *pair, const PixelGradients *g, const uint own) {
    return by_sample(pair->of_pixels + BLOCK_PIXELS * own);
}

// Adds G times the weights of a block's samples.
ALWAYS_INLINE void
add_weights(PairGradients *pair, const PixelGradients *g, const uint own, const float16 b) {
    float w[BLOCK_PIXELS];
    sum_pixels(b, w);
    const float16 *G = g->of_features + BLOCK_PIXELS * own;
    UNROLLED_FOR (uint k = 0; k < BLOCK_PIXELS; k += 4) {
        pair->of_features += w[k] * G[k] + w[k + 1] * G[k + 1];
        pair->of_others += w[k + 2] * G[k + 2] + w[k + 3] * G[k + 3];
    }
}

// The sums of SUMS vectors.
ALWAYS_INLINE Sums sum_of_each(const float16 v[SUMS]) {
#if !MOVED
    return (Sums)(sum16(v[0]), sum16(v[1]));
#else
    float16 halves[4];
    for (int i = 0; i < 4; i++)
        halves[i] =
            (float16)(v[2 * i].lo, v[2 * i + 1].lo) + (float16)(v[2 * i].hi, v[2 * i + 1].hi);
    float16 quarters[2];  // of 0, 2, 1, 3 and 4, 6, 5, 7
    for (int i = 0; i < 2; i++) {
        const float16 a = halves[2 * i], b = halves[2 * i + 1];
        quarters[i] = (float16)(a.lo.lo, b.lo.lo, a.hi.lo, b.hi.lo) +
                      (float16)(a.lo.hi, b.lo.hi, a.hi.hi, b.hi.hi);
    }
    const float16 a = quarters[0], b = quarters[1];
    const float16 twos = (float16)(a.s01, b.s01, a.s45, b.s45, a.s89, b.s89, a.scd, b.scd) +
                         (float16)(a.s23, b.s23, a.s67, b.s67, a.sab, b.sab, a.sef, b.sef);
    const float8 sums = twos.even + twos.odd;  // of 0, 4, 2, 6, 1, 5, 3, 7
    return (float8)(sums.s0, sums.s4, sums.s2, sums.s6, sums.s1, sums.s5, sums.s3, sums.s7);
#endif
}

ALWAYS_INLINE void store_pair(
    const PairGradients *pair,
    const PixelGradients *g,
    const float16 sums[SUMS],
    global float16 *features_row,
    global float *sums_row) {
    *features_row = pair->of_features + pair->of_others;
    STORE_SUMS(sum_of_each(sums), 0, sums_row);
}
#endif

// What a tile's samples begin with on the way back: the gradients of their pixels, and G times what
// shows in place of a fragment, for alpha compositing the background.
ALWAYS_INLINE void gradients_load(
    const Tile *tile,
    global const float16 *features,
    global const float16 *grad_features,
    global const float *grad_alpha,
    global const float2 *depth_gradient,
    PixelGradients *g,
    floats behind[OWN_BLOCKS]) {
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        float of_pixel[OWN_PIXELS];
        FOR_PIXELS(k) {
            const uint q = pixel_of(tile, own, k), at = own * OWN_PIXELS + OF_PIXEL(k);
            const bool is_there = q != NONE;
            const float16 G = is_there ? grad_features[q] / SAMPLES : 0.0f;
            const float2 depth = is_there && depth_gradient ? depth_gradient[q] : 0.0f;
            g->of_features[at] = G;
            ((float *)g->of_alpha)[at] = is_there && grad_alpha ? grad_alpha[q] / SAMPLES : 0.0f;
            ((float *)g->of_range)[at] = depth.x / SAMPLES;
            ((float *)g->mean)[at] = depth.y;
            of_pixel[OF_PIXEL(k)] = dot16(G, SOFTMAX && is_there ? features[q] : BACKGROUND);
        }
#if GROUP > 1
        behind[own] = of_pixel[0];
        for (int i = 0; i < 16; i++) {
            const uint pixel = GROUP * own + MEMBER / 16 * 16 + i;
            const uint q = pixel_in(tile, pixel / BLOCK_PIXELS, pixel % BLOCK_PIXELS);
            global const float *G = (global const float *)grad_features + CHANNELS * (size_t)q;
            g->of_channel[own][i] = q == NONE ? 0.0f : G[MEMBER % 16] / SAMPLES;
        }
#else
        behind[own] = by_sample(of_pixel);
#endif
    }
#if GROUP == 1
    for (uint pixel = 0; pixel < BLOCKS * BLOCK_PIXELS; pixel++)
        for (uint c = 0; c < CHANNELS; c++)
            ((float *)g->of_channel)[16 * (pixel / 16 * CHANNELS + c) + pixel % 16] =
                ((const float *)g->of_features)[CHANNELS * pixel + c];
#endif
}

#endif
