// Features blended by the weights of compositing.h, and the backward pass: each tile writes what its
// samples add to the gradients of its points by pair, and each visible point sums its pairs: no
// atomics.
//
// F = sum b_i f_i + b_0 BACKGROUND, with G = dL/dF
// dL/df_i = sum b_i G,  dL/do_i = sum s_i dL/db_i, where s_i is the derivative of b_i by o_i.
//
// dL/db of a fragment is the change of the loss per unit of weight that moves to it from whatever
// would show in its place:
//
// Softmax: in its place shows the blend of all fragments, so dL/db_i = G.f_i - G.F, and s_i = b_i
// (1/o_i + z_i/gamma), finite at o = 0.
//
// Alpha compositing: in its place shows what lies behind it, composited to R_i, so dL/db_i = G.f_i -
// B_i with B_i = G.R_i, and dL/dalpha_i = T_i dL/db_i. B_i and T_i are found on the way from back to
// front: B_(i-1) = B_i + alpha_i dL/db_i, T_i = T_(i+1) / (1 - alpha_i). A gradient g of the pixel's
// alpha, 1 - T, acts as one more feature that is 1 at all points and 0 at the background: G.f becomes
// G.f + g. The distortion loss of a sample, w sum_ij b_i b_j |z_i - z_j| (Mip-NeRF 360, Eq. 15), adds
// its derivative with respect to b_i to G.f_i in the same way, and so does the depth loss
// (training/depth_loss.cl).
#include "raster/compositing.h"

#ifndef MOVED
#define MOVED MOVES  // 1: gradients of offsets, too
#endif
#include "raster/sums.h"

// GROUP work-items per tile: read the points that show, nearest first, and their features, write
// those of the tile's pixels.
kernel void blend_forward(
    const uint tiles,                        //
    const float limit,                       // early_stop, or 1 / gamma
    global const float *camera,              // (21) camera.h, of the samples
    global const uint *point_record,         // (N, RECORD) footprint.h
    global const uint *tile_offset,          // (TILES+1)
    global const ulong *shown,               // (P) blocks << 32 | point, by tile
    global const uint *tile_shown,           // (TILES)
    global const uint *point_slot,           // (N) row of a visible point
    global const float16 *visible_features,  // (?, 16) of the visible points
    global const float *transmittance,       // (HW) weight of the background
    global const float *sample_state,        // (2, ?, 16) M, 1/D; NULL without SOFTMAX
    global const int *sample_end,            // (?, 16) NULL alike
    global float16 *features)                // (H, W, 16)
{
    SHARED_LIST
    SHARED_FEATURES
    if (GROUP_ID >= tiles) return;
    const Tile tile = tile_load(camera, GROUP_ID);
    const Rule rule = rule_of(&tile.cam, limit);
    const uint begin = tile_offset[tile.number], end = begin + tile_shown[tile.number];
    Rays rays[OWN_BLOCKS];
    Sample samples[OWN_BLOCKS];
    ints inside[OWN_BLOCKS];
    float16 sums[OWN_BLOCKS * OWN_PIXELS];
    tile_rays(&tile, rays, inside);
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        SAMPLE_BEGIN(samples[own], &tile, own, inside[own])
        for (uint k = 0; k < OWN_PIXELS; k++)
            sums[own * OWN_PIXELS + k] = 0.0f;
    }
    for (uint first = begin, batch; first < end; first += batch) {
        batch = BATCH(end - first);
        READ_BATCH(shown[first + k])
        READ_FEATURES
        for (uint k = 0; k < batch; k++) {
            const ulong soon = shown[min(first + k + PAIRS_AHEAD, end - 1)];
            READ_POINT_AHEAD(soon)
            READ_FEATURES_AHEAD(soon, shown[min(first + k + FEATURES_AHEAD, end - 1)])
            const ulong entry = ENTRY(shown[first + k]);
            const Point point = POINT(entry);
            const float16 f = FEATURES(entry);
            FOR_BLOCKS(own, (uint)(entry >> 32)) {
                const Coverage at = coverage_at(rays + own, &point);
                ints shows;
                const floats b =
                    weigh(samples + own, &rule, &point, &at, first + k - begin, &shows);
                add_features(sums + own * OWN_PIXELS, b, f);
            }
        }
    }
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        FOR_PIXELS(k) {
            const uint q = pixel_of(&tile, own, k);
            if (q != NONE)
                features[q] =
                    sums[own * OWN_PIXELS + OF_PIXEL(k)] / SAMPLES + transmittance[q] * BACKGROUND;
        }
    }
}

// The gradients of a tile's pixels, of each sample's share: those of features, and the loss's
// derivatives by alpha and, with its mean range, by range.
#if GROUP > 1
#define ROWS (GROUP / 16)  // of work-items that first add up by 16

typedef struct {
    float16 of_features[OWN_BLOCKS];  // of a work-item's pixel
    float of_alpha[OWN_BLOCKS], of_range[OWN_BLOCKS], mean[OWN_BLOCKS];
    float of_channel[OWN_BLOCKS][16];  // of the 16 pixels that it adds up, one channel
} PixelGradients;

#define SHARED_SUMS                                                                                \
    local float shared_weight[OWN_BLOCKS * GROUP], shared_sums[SUMS * GROUP];                      \
    local float shared_rows[ROWS * (CHANNELS + SUMS)];

#define FEATURE_ROW const float16 f = FEATURES(entry);
#define ADD_PIXELS_OF_POINT
#define OF_POINT(own)                                                                              \
    (dot16(g.of_features[own], f) + g.of_alpha[own] + g.of_range[own] * (range - g.mean[own]))
#define ADD_WEIGHTS(own, b) shared_weight[GROUP * own + MEMBER] = SUM_LANES(b);

// Adds up the weights and sums of all pixels, in a fixed order: first 16 by 16, then these.
#define SUM_PAIR                                                                                   \
    for (uint s = 0; s < SUMS; s++)                                                                \
        shared_sums[GROUP * s + MEMBER] = SUM_LANES(sums[s]);                                      \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                  \
    float of_row = 0.0f;                                                                           \
    UNROLLED_FOR (uint own = 0; own < OWN_BLOCKS; own++)                                           \
        for (uint i = 0; i < 16; i++) {                                                            \
            const uint pixel = GROUP * own + MEMBER / 16 * 16 + i;                                 \
            if (blocks >> pixel / BLOCK_PIXELS & 1)                                                \
                of_row += shared_weight[pixel] * g.of_channel[own][i];                             \
        }                                                                                          \
    shared_rows[MEMBER] = of_row;                                                                  \
    for (uint i = MEMBER; i < ROWS * SUMS; i += GROUP) {                                           \
        float sum = 0.0f;                                                                          \
        for (uint item = 16 * i; item < 16 * i + 16; item++)                                       \
            sum += shared_sums[item];                                                              \
        shared_rows[ROWS * CHANNELS + i] = sum;                                                    \
    }                                                                                              \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                  \
    for (uint i = MEMBER; blocks && i < CHANNELS + SUMS; i += GROUP) {                             \
        const uint from = i < CHANNELS ? i : ROWS * i, step = i < CHANNELS ? CHANNELS : 1;         \
        float sum = 0.0f;                                                                          \
        for (uint row = 0; row < ROWS; row++)                                                      \
            sum += shared_rows[from + step * row];                                                 \
        if (i < CHANNELS)                                                                          \
            ((global float *)row_of_features)[i] = sum;                                            \
        else                                                                                       \
            pair_sums[SUMS * (size_t)pair + i - CHANNELS] = sum;                                   \
        if (i == 0) pair_shows[pair] = 1;                                                          \
    }
#else
#define BLOCKS_TOGETHER SAMPLES  // have 16 pixels
#define PARTS (BLOCKS / BLOCKS_TOGETHER)

typedef struct {
    float16 of_features[BLOCKS * BLOCK_PIXELS];
    float16 of_channel[CHANNELS * PARTS];  // the same: 16 pixels by channel
    float16 of_alpha[PARTS], of_range[PARTS], mean[PARTS];
} PixelGradients;

#define SHARED_SUMS
#define FEATURE_ROW                                                                                \
    global const float *row = (global const float *)(visible_features + point_slot[(uint)entry]);

// G.f of 16 pixels at a time, of those parts of the tile that have any of the blocks.
#define ADD_PIXELS_OF_POINT                                                                        \
    float of_pixels[BLOCKS * BLOCK_PIXELS];                                                        \
    float16 of_point = 0.0f, of_others = 0.0f;                                                     \
    for (uint left = blocks; left;) {                                                              \
        const uint part = (31 - clz(left & -left)) / BLOCKS_TOGETHER;                              \
        left &= ~(((1u << BLOCKS_TOGETHER) - 1) << part * BLOCKS_TOGETHER);                        \
        float16 one = g.of_alpha[part] + g.of_range[part] * (range - g.mean[part]), other = 0.0f;  \
        UNROLLED_FOR (uint c = 0; c < CHANNELS; c += 2) {                                          \
            one += row[c] * g.of_channel[CHANNELS * part + c];                                     \
            other += row[c + 1] * g.of_channel[CHANNELS * part + c + 1];                           \
        }                                                                                          \
        vstore16(one + other, part, of_pixels);                                                    \
    }
#define OF_POINT(own) of_samples(of_pixels + BLOCK_PIXELS * own)
#define ADD_WEIGHTS(own, b)                                                                        \
    {                                                                                              \
        float w[BLOCK_PIXELS];                                                                     \
        sum_pixels(b, w);                                                                          \
        const float16 *G = g.of_features + BLOCK_PIXELS * own;                                     \
        UNROLLED_FOR (uint k = 0; k < BLOCK_PIXELS; k += 4) {                                      \
            of_point += w[k] * G[k] + w[k + 1] * G[k + 1];                                         \
            of_others += w[k + 2] * G[k + 2] + w[k + 3] * G[k + 3];                                \
        }                                                                                          \
    }
#define SUM_PAIR                                                                                   \
    *row_of_features = of_point + of_others;                                                       \
    STORE_SUMS(sum_of_each(sums), pair, pair_sums);                                                \
    pair_shows[pair] = 1;

// Values of the pixels of a block, for each sample.
ALWAYS_INLINE float16 of_samples(const float *of_pixels) {
#if SAMPLES == 4
    const float4 once = vload4(0, of_pixels);
    return (float16)(once, once, once, once);
#else
    return vload16(0, of_pixels);
#endif
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
        behind[own] = of_samples(of_pixel);
#endif
    }
#if GROUP == 1
    for (uint pixel = 0; pixel < BLOCKS * BLOCK_PIXELS; pixel++)
        for (uint c = 0; c < CHANNELS; c++)
            ((float *)g->of_channel)[16 * (pixel / 16 * CHANNELS + c) + pixel % 16] =
                ((const float *)g->of_features)[CHANNELS * pixel + c];
#endif
}

// GROUP work-items per tile: read the points that show, farthest first, and write by pair what the
// tile's samples add to the gradients of its point: of its features, and the sums b, dL/do and those
// of derivatives_add(); and the distortion loss of the tile without its weight. A sample's share of
// them is 1 / SAMPLES.
kernel void blend_backward(
    const uint tiles,                        //
    const float limit,                       // early_stop, or 1 / gamma
    const float distortion_weight,           // of a sample; 0: none, `distortion` is not written
    global const float *camera,              // (21) camera.h, of the samples
    global const uint *point_record,         // (N, RECORD) footprint.h
    global const uint *point_offset,         // (N+1) first pair of each point
    global const uint *tile_offset,          // (TILES+1)
    global const ulong *pair_key,            // (P) depth << 32 | point
    global const ulong *shown,               // (P) blocks << 32 | point, by tile
    global const uint *tile_shown,           // (TILES)
    global const uint *point_slot,           // (N) row of a visible point
    global const float16 *visible_features,  // (?, 16) of the visible points
    global const float *sample_state,        // (2, ?, 16) as weights.cl writes them
    global const int *sample_end,            // (?, 16) rank behind the last fragment with gradients
    global const float16 *features,          // (H, W, 16) F, NULL without SOFTMAX
    global const float16 *grad_features,     // (H, W, 16) G
    global const float *grad_alpha,          // (HW) g, may be NULL
    global const float2 *depth_gradient,     // (HW, 2) depth_loss.cl, may be NULL
    global float16 *pair_features,           // (P, 16) of points that may cover several tiles
    global float16 *grad_visible_features,   // (?, 16) of the others, a row for each visible point
    global float *pair_sums,                 // (P, SUMS)
    global uchar *pair_shows,                // (P) 1 where they are written; cleared before
    global float *distortion)                // (TILES)
{
    SHARED_LIST
    SHARED_FEATURES
    SHARED_SUMS
    SHARED(float, shared, GROUP);
    if (GROUP_ID >= tiles) return;
    const Tile tile = tile_load(camera, GROUP_ID);
    const Rule rule = rule_of(&tile.cam, limit);
    const uint begin = tile_offset[tile.number], count = tile_shown[tile.number];
    Rays rays[OWN_BLOCKS];
    Sample samples[OWN_BLOCKS];
    PixelGradients g;
    floats behind[OWN_BLOCKS], front_sum[OWN_BLOCKS], loss = 0.0f;
    ints inside[OWN_BLOCKS];
    if (count > 0) {
        tile_rays(&tile, rays, inside);
        gradients_load(&tile, features, grad_features, grad_alpha, depth_gradient, &g, behind);
    }
    const size_t sum_row = BLOCKS * (size_t)tiles;
    for (uint own = 0; own < OWN_BLOCKS && count > 0; own++) {
        const size_t row = SAMPLE_ROW(&tile, own);
#if SOFTMAX
        SAMPLE_BEGIN(samples[own], &tile, own, inside[own])
#else
        samples[own].T = SAMPLE_VALUES(const floats, sample_state, row);
        front_sum[own] = SAMPLE_VALUES(const floats, sample_state, sum_row + row);
#endif
    }
    const float nearest = count > 0 ? upper_float(pair_key[begin]) : 0.0f;
    for (uint first = 0, batch; first < count; first += batch) {
        batch = BATCH(count - first);
        READ_BATCH(shown[begin + count - 1 - first - k])
        READ_FEATURES
        for (uint k = 0; k < batch; k++) {
            const uint rank = count - 1 - first - k;
            const ulong soon = shown[begin + rank - min(rank, (uint)PAIRS_AHEAD)];
            READ_POINT_AHEAD(soon)
            READ_AHEAD(point_offset + (uint)soon);
            READ_FEATURES_AHEAD(soon, shown[begin + rank - min(rank, (uint)FEATURES_AHEAD)])
            const ulong entry = ENTRY(shown[begin + rank]);
            const Point point = POINT(entry);
            const uint blocks = (uint)(entry >> 32);
            const uint pair = pair_of(&point, &tile, point_offset[(uint)entry]);
            const float range = DEPTH(&point), z = range - nearest;
            global float16 *row_of_features = IS_IN_ONE_TILE(point)
                                                  ? grad_visible_features + point_slot[(uint)entry]
                                                  : pair_features + pair;
            FEATURE_ROW
            floats sums[SUMS];
            UNROLLED_FOR (uint s = 0; s < SUMS; s++)
                sums[s] = 0.0f;
            ADD_PIXELS_OF_POINT;
            FOR_BLOCKS(own, blocks) {
                Sample *s = samples + own;
                const Coverage at = coverage_at(rays + own, &point);
                floats dL_db = OF_POINT(own) - behind[own];
#if SOFTMAX
                ints shows;
                const floats share = share_of(s, &rule, &point, &at, rank, &shows);
                const floats b = point.opacity * share;
                const float a = point.opacity * normalised_depth(&rule, &point) * rule.limit;
                dL_db = select((floats)(0.0f), dL_db, shows);
                sums[1] += share * (1.0f + a) * dL_db;
#else
                const size_t kept = SAMPLE_ROW(&tile, own);
                const ints end = SAMPLE_VALUES(const ints, sample_end, kept);
                ints shows = at.covers & (end > (int)rank);
                const floats alpha = alpha_of(&point, &at, &shows);
                const floats after = s->T, before = after * inverse(pass_through(alpha));
                const floats b = before * alpha;
                s->T = before;
                if (distortion_weight > 0.0f) {
                    // sums of b in front and behind follow from the transmittances
                    const floats front = front_sum[own] - b * z;
                    const floats last = SAMPLE_VALUES(const floats, sample_state, kept);
                    const floats all = SAMPLE_VALUES(const floats, sample_state, sum_row + kept);
                    const floats distances =
                        z * (1.0f - before - after + last) - (front + front_sum[own] - all);
                    front_sum[own] = front;
                    dL_db += 2.0f * distortion_weight * distances;
                    loss += b * distances;
                }
                dL_db = select((floats)(0.0f), dL_db, shows);  // also where it is not finite
                behind[own] += alpha * dL_db;
                const floats shift = before * dL_db;
                sums[1] += shift * at.falloff;
#if MOVED
                derivatives_add(sums + 2, rays + own, &point, &at, shift);
#endif
#endif
                sums[0] += b;
                ADD_WEIGHTS(own, b)
            }
            SUM_PAIR
        }
    }
    if (distortion_weight > 0.0f) {
        const float sum = group_sum(SUM_LANES(loss), shared);
        if (MEMBER == 0) distortion[tile.number] = sum;
    }
}
