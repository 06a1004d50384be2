// The walk of alpha compositing that finds the points that show: in which blocks of a tile, with which
// weights, and what other walks need of each sample.
#include "raster/shown.h"

#ifndef DERIVATIVES
#define DERIVATIVES 1  // 0: nothing that only gradients need
#endif

// GROUP work-items per tile: read its points, nearest first, write those that
// show with the blocks where they do, and of each pixel the transmittance behind all, the mean range
// of what shows by its weights, and whether its part of the image shows anything.
kernel void alpha_weights(
    const uint tiles,                 //
    const uint p,                     // capacity, in pairs
    const float early_stop,           // T behind which fragments are dropped, at least 1e-20
    global const float *camera,       // (21) camera.h, of the samples
    global const uint *point_record,  // (N, RECORD) footprint.h
    global const uint *tile_offset,   // (TILES+1) first pair of each tile
    global const ulong *pair_key,     // (P) depth << 32 | point, sorted within a tile
    global ulong *shown,              // (P) blocks << 32 | point, alike
    global uint *tile_shown,          // (TILES) how many
    global uchar *point_is_visible,   // (N) 1: shows in a sample
    global float *transmittance,      // (HW) mean of those of the samples
    global float *mean_range,         // (HW) distance from the eye; 0 where nothing shows
    global int *is_covered,           // (?, ?) parts of 4 x 4 pixels
    global float *sample_state,  // (2, ?, 16) T, sum b (range - nearest); NULL without DERIVATIVES
    global int *sample_end)      // (?, 16) rank behind the last that shows; NULL alike
{
    SHARED_LIST
    SHARED_BLOCKS
    if (GROUP_ID >= tiles) return;
    const Tile tile = tile_load(camera, GROUP_ID);
    const Rule rule = rule_of(&tile.cam, early_stop);
    const uint begin = tile_offset[tile.number];
    const uint end = tile_offset[tiles] > p ? begin : tile_offset[tile.number + 1];
    Rays rays[OWN_BLOCKS];
    Sample samples[OWN_BLOCKS];
    floats ranges[OWN_BLOCKS];
    ints ends[OWN_BLOCKS], inside[OWN_BLOCKS];
    uint live = tile_rays(&tile, rays, inside), rank = 0;
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        SAMPLE_BEGIN(samples[own], &tile, own, inside[own])
        ranges[own] = 0.0f;
        ends[own] = 0;
    }
    // ranges count from here, so that sums of them keep their digits
    const float nearest = begin < end ? upper_float(pair_key[begin]) : 0.0f;
    for (uint first = begin, batch; first < end && ANY_MEMBER(live); first += batch) {
        batch = BATCH(end - first);
        BEGIN_BLOCKS
        READ_BATCH(pair_key[first + k])
        for (uint k = 0; k < batch && !IS_DONE(live); k++) {
            READ_POINT_AHEAD(pair_key[min(first + k + PAIRS_AHEAD, end - 1)])
            const ulong key = ENTRY(pair_key[first + k]);
            const Point point = POINT(key);
            const float range = upper_float(key) - nearest;
            uint blocks = 0;
            FOR_BLOCKS(own, blocks_of(&point, &tile) & live) {
                const Coverage at = coverage_at(rays + own, &point);
                ints shows;
                const floats b = weigh(samples + own, &rule, &point, &at, rank, &shows);
                ranges[own] += b * range;
                if (DERIVATIVES) ends[own] = select(ends[own], (ints)(rank + 1), shows);
                ADD_BLOCK(own, shows)
                if (!any_sample(samples[own].T >= early_stop)) live &= ~(1u << BLOCK(own));
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
        if (DERIVATIVES) {
            SAMPLE_VALUES(floats, sample_state, row) = samples[own].T;
            SAMPLE_VALUES(floats, sample_state, row + BLOCKS * (size_t)tiles) = ranges[own];
            SAMPLE_VALUES(ints, sample_end, row) = ends[own];
        }
        float rest[OWN_PIXELS], range[OWN_PIXELS];
        sum_pixels(samples[own].T, rest);
        sum_pixels(ranges[own], range);
        FOR_PIXELS(k) {
            const uint q = pixel_of(&tile, own, k);
            if (q == NONE) continue;
            const float T = rest[OF_PIXEL(k)] / SAMPLES;
            transmittance[q] = T;
            mean_range[q] = T == 1.0f ? 0.0f : nearest + range[OF_PIXEL(k)] / SAMPLES / (1.0f - T);
        }
    }
}
