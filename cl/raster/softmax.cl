// weights.cl for the softmax: the walk for M, D and where samples stop.
#define SOFTMAX 1
#include "raster/shown.h"

#ifndef DROPS
#define DROPS 1  // early_stop may be above 0
#endif

// GROUP work-items per tile: as alpha_weights. A fragment is dropped, with all behind it,
// once even an opaque, centred fragment (o = d = 1) would have less than the share early_stop of the
// weight; differs from Pulsar: it looks only when its buffer is flushed.
kernel void softmax_weights(
    const uint tiles,                 //
    const uint p,                     // capacity, in pairs
    const float sharpness,            // 1 / gamma
    const float early_stop,           // 0: none
    const uint tracked,               // fragments of a pixel that get gradients
    global const float *camera,       // (21) camera.h
    global const uint *point_record,  // (N, RECORD) footprint.h
    global const uint *tile_offset,   // (TILES+1) first pair of each tile
    global const ulong *pair_key,     // (P) depth << 32 | point, sorted within a tile
    global ulong *shown,              // (P) blocks << 32 | point, alike
    global uint *tile_shown,          // (TILES) how many
    global uchar *point_is_visible,   // (N) 1: shows in a sample
    global float *transmittance,      // (HW) weight of the background
    global int *is_covered,           // (?, ?) parts of 4 x 4 pixels
    global float *sample_state,       // (2, ?, 16) M, 1/D
    global int *sample_end,           // (?, 16) rank behind the last that shows
    global int *sample_tracked)       // (?, 16) rank behind the last with gradients
{
    SHARED_LIST
    SHARED_BLOCKS
    if (GROUP_ID >= tiles) return;
    const Tile tile = tile_load(camera, GROUP_ID);
    const Rule rule = rule_of(&tile.cam, sharpness);
    const uint begin = tile_offset[tile.number];
    const uint end = tile_offset[tiles] > p ? begin : tile_offset[tile.number + 1];
    const float background = EPS * sharpness, least = early_stop / (1.0f - early_stop);
    Rays rays[OWN_BLOCKS];
    Sample samples[OWN_BLOCKS];
    floats D[OWN_BLOCKS];
    ints ends[OWN_BLOCKS], tracked_ends[OWN_BLOCKS], counts[OWN_BLOCKS], is_live[OWN_BLOCKS];
    uint live = tile_rays(&tile, rays, is_live), rank = 0;
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        samples[own].M = background;
        D[own] = 1.0f;  // the background alone
        ends[own] = tracked_ends[own] = counts[own] = 0;
    }
    for (uint first = begin, batch; first < end && ANY_MEMBER(live); first += batch) {
        batch = BATCH(end - first);
        BEGIN_BLOCKS
        READ_BATCH(pair_key[first + k])
        for (uint k = 0; k < batch && !IS_DONE(live); k++) {
            READ_POINT_AHEAD(pair_key[min(first + k + PAIRS_AHEAD, end - 1)])
            const ulong key = ENTRY(pair_key[first + k]);
            const Point point = POINT(key);
            const float z = normalised_depth(&rule, &point), o_z = point.opacity * z;
            uint blocks = 0;
            FOR_BLOCKS(own, blocks_of(&point, &tile) & live) {
                Sample *s = samples + own;
                const Coverage at = coverage_at(rays + own, &point);
                ints shows = at.covers & is_live[own];
                const ints weighs = shows & (at.falloff > 0.0f);
                const floats M = select(s->M, fmax(s->M, o_z * sharpness), weighs);
                if (any_sample(M > s->M)) {
                    D[own] *= exp(s->M - M);
                    s->M = M;
                }
                if (DROPS) {
                    const floats best =
                        exp(-fma((floats)(-fmax(z, 0.0f)), (floats)(sharpness), s->M));
                    const ints stops = shows & (best < least * D[own]);
                    is_live[own] &= ~stops;
                    shows &= ~stops;
                    if (!any_sample(is_live[own])) live &= ~(1u << BLOCK(own));
                }
                const floats term = point.opacity * at.falloff * exponential(o_z, sharpness, s->M);
                D[own] += select((floats)(0.0f), term, shows);
                counts[own] += select((ints)(0), (ints)(1), shows);
                ends[own] = select(ends[own], (ints)(rank + 1), shows);
                tracked_ends[own] = select(
                    tracked_ends[own], (ints)(rank + 1),
                    shows & (LANED(convert_uint)(counts[own]) <= tracked));
                ADD_BLOCK(own, shows)
            }
            END_ENTRY
        }
        END_BLOCKS
    }
    if (MEMBER == 0) tile_shown[tile.number] = rank;
    ANY_MEMBER(0);
    store_covered(&tile, ALL_COVERED, is_covered);
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        const size_t row = SAMPLE_ROW(&tile, own);
        const floats per_D = 1.0f / D[own];
        SAMPLE_VALUES(floats, sample_state, row) = samples[own].M;
        SAMPLE_VALUES(floats, sample_state, row + BLOCKS * (size_t)tiles) = per_D;
        SAMPLE_VALUES(ints, sample_end, row) = ends[own];
        SAMPLE_VALUES(ints, sample_tracked, row) = tracked_ends[own];
        float rest[OWN_PIXELS];
        sum_pixels(exp(background - samples[own].M) * per_D, rest);
        FOR_PIXELS(k) {
            const uint q = pixel_of(&tile, own, k);
            if (q != NONE) transmittance[q] = rest[OF_PIXEL(k)];
        }
    }
}
