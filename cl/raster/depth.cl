// Alpha, mean depth and median depth of each pixel, from the weights of its fragments.
//
// A fragment's depth is where a sample's ray meets the point: the front of the ball of its radius
// where footprints are soft. Points stand for what surrounds them, so the surface lies in front of
// their centres.
#include "raster/compositing.h"

#define INFINITE (floats)(INFINITY)

// GROUP work-items per tile: read the points that show, nearest first, twice, and write the share of
// each pixel that is not background, and the depth of that along the camera's axis: the mean by
// weight, and where half of the weight is reached, which grows evenly from fragment to fragment.
// Where a pixel has several samples, the mean of those within a voxel of the nearest, as others show
// what is behind an edge. A sample that an early stop of alpha compositing has ended is opaque: what
// it dropped would let less than the stop pass.
kernel void depth_forward(
    const uint tiles,                  //
    const float limit,                 // early_stop, or 1 / gamma
    const float voxel_size,            // world units
    global const float *camera,        // (21) camera.h, of the samples
    global const uint *point_record,   // (N, RECORD) footprint.h
    global const uint *tile_offset,    // (TILES+1)
    global const ulong *shown,         // (P) blocks << 32 | point, by tile
    global const uint *tile_shown,     // (TILES)
    global const float *sample_state,  // (2, ?, 16) M, 1/D; NULL without SOFTMAX
    global const int *sample_end,      // (?, 16) NULL alike
    global float *pixel_alpha,         // (HW)
    global float *pixel_depth,         // (HW) infinite where there is no fragment
    global float *pixel_median)        // (HW) infinite where there is no fragment
{
    SHARED_LIST
    if (GROUP_ID >= tiles) return;
    const Tile tile = tile_load(camera, GROUP_ID);
    const Rule rule = rule_of(&tile.cam, limit);
    const uint begin = tile_offset[tile.number], end = begin + tile_shown[tile.number];
    Rays rays[OWN_BLOCKS];
    Sample samples[OWN_BLOCKS];
    floats alpha[OWN_BLOCKS], depth[OWN_BLOCKS], median[OWN_BLOCKS];
    floats reached[OWN_BLOCKS], before[OWN_BLOCKS];
    ints is_behind[OWN_BLOCKS], inside[OWN_BLOCKS];  // another fragment of the sample
    tile_rays(&tile, rays, inside);
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        alpha[own] = depth[own] = median[own] = reached[own] = before[own] = 0.0f;
        is_behind[own] = 0;
    }
    for (uint pass = 0; pass < 2; pass++) {
        for (uint own = 0; own < OWN_BLOCKS; own++) {
            SAMPLE_BEGIN(samples[own], &tile, own, inside[own])
        }
        for (uint first = begin, batch; first < end; first += batch) {
            batch = BATCH(end - first);
            READ_BATCH(shown[first + k])
            for (uint k = 0; k < batch; k++) {
                const ulong entry = ENTRY(shown[first + k]);
                const Point point = POINT(entry);
                FOR_BLOCKS(own, (uint)(entry >> 32)) {
                    const Coverage at = coverage_at(rays + own, &point);
                    ints shows;
                    const floats b =
                        weigh(samples + own, &rule, &point, &at, first + k - begin, &shows);
                    if (pass == 0) {
                        alpha[own] += b;
                        continue;
                    }
                    const floats surface =
                        surface_range(DEPTH(&point), fabs(point.size), at.falloff);
                    const floats z = select((floats)(0.0f), rays[own].per_length * surface, shows);
                    depth[own] += b * z;
                    const floats half_left = 0.5f * alpha[own] - reached[own];
                    const floats share =
                        select((floats)(1.0f), fmin(half_left / b, 1.0f), b > 0.0f);
                    const floats there =
                        select(z, before[own] + share * (z - before[own]), is_behind[own]);
                    median[own] = select(median[own], there, shows & (half_left > 0.0f));
                    reached[own] += b;
                    before[own] = select(before[own], z, shows);
                    is_behind[own] |= shows;
                }
            }
        }
    }
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        const ints is_there = alpha[own] > 0.0f;
        // infinite without weight, as where rounding at the very rim leaves less than 0; a NaN stays
        const floats missing = select(alpha[own], INFINITE, alpha[own] <= 0.0f);
        depth[own] = select(missing, depth[own] / alpha[own], is_there);
        median[own] = select(missing, median[own], is_there);
#if SOFTMAX
        const ints is_opaque = alpha[own] > 1.0f;
#else
        const ints is_opaque = (samples[own].T < limit & is_there) | (alpha[own] > 1.0f);
#endif
        float sums[OWN_PIXELS], counted[OWN_PIXELS];
        sum_pixels(select(alpha[own], (floats)(1.0f), is_opaque), sums);
        FOR_PIXELS(k) {
            const uint q = pixel_of(&tile, own, k);
            if (q != NONE) pixel_alpha[q] = sums[OF_PIXEL(k)] / SAMPLES;
        }
        const floats of_both[2] = {depth[own], median[own]};
        global float *const both[2] = {pixel_depth, pixel_median};
        for (uint i = 0; i < 2; i++) {
            const floats nearest = least_of_pixels(of_both[i]);
            const ints counts = !(of_both[i] > nearest + voxel_size);
            sum_pixels(select((floats)(0.0f), of_both[i], counts), sums);
            sum_pixels(select((floats)(0.0f), (floats)(1.0f), counts), counted);
            FOR_PIXELS(k) {
                const uint q = pixel_of(&tile, own, k);
                if (q != NONE) both[i][q] = sums[OF_PIXEL(k)] / counted[OF_PIXEL(k)];
            }
        }
    }
}
