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
#include "raster/gradients.h"

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
            floats sums[SUMS];
            UNROLLED_FOR (uint s = 0; s < SUMS; s++)
                sums[s] = 0.0f;
            PairGradients of_pair = PAIR_BEGIN(&g, FEATURE_ROW(entry), blocks, range);
            FOR_BLOCKS(own, blocks) {
                Sample *s = samples + own;
                const Coverage at = coverage_at(rays + own, &point);
                floats dL_db = of_samples(&of_pair, &g, own) - behind[own];
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
                add_weights(&of_pair, &g, own, b);
            }
            global float16 *features_row = IS_IN_ONE_TILE(point)
                                               ? grad_visible_features + point_slot[(uint)entry]
                                               : pair_features + pair;
            store_pair(&of_pair, &g, sums, features_row, pair_sums + SUMS * (size_t)pair);
            if (MEMBER == 0 && blocks) pair_shows[pair] = 1;
        }
    }
    if (distortion_weight > 0.0f) {
        const float sum = group_sum(SUM_LANES(loss), shared);
        if (MEMBER == 0) distortion[tile.number] = sum;
    }
}
