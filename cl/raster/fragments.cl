// The fragments of a view, points in pixels that they cover a sample of: their numbers, and lists of
// them. No training and no image needs these; they are counted and listed for people and tests.
#include "raster/compositing.h"

// GROUP work-items per tile: read its points, nearest first, write how many cover each pixel and how
// many of them are not dropped and, with is_listed, all of them in the same order: the point, the mean
// of its falloffs where it covers samples, the mean of its weights, and whether it is not dropped.
kernel void fragments_list(
    const uint tiles,                  //
    const float limit,                 // early_stop, or 1 / gamma
    const int is_listed,               // 0: fragments are only counted
    global const float *camera,        // (21) camera.h, of the samples
    global const uint *point_record,   // (N, RECORD) footprint.h
    global const uint *tile_offset,    // (TILES+1)
    global const ulong *pair_key,      // (P) depth << 32 | point
    global const ulong *shown,         // (P) blocks << 32 | point, by tile
    global const uint *tile_shown,     // (TILES)
    global const float *sample_state,  // (2, ?, 16) M, 1/D; NULL without SOFTMAX
    global const int *sample_end,      // (?, 16) NULL alike
    global const uint *pixel_offset,   // (HW+1) first fragment of a pixel; NULL without is_listed
    global uint *pixel_count,          // (HW) fragments
    global uint *pixel_shown,          // (HW) those that are not dropped
    global uint *fragment_point,       // (?) NULL without is_listed
    global float *fragment_falloff,    // (?) NULL alike
    global float *fragment_weight,     // (?) NULL alike
    global uchar *fragment_shows)      // (?) NULL alike
{
    SHARED_LIST
    if (GROUP_ID >= tiles) return;
    const Tile tile = tile_load(camera, GROUP_ID);
    const Rule rule = rule_of(&tile.cam, limit);
    const uint begin = tile_offset[tile.number], end = tile_offset[tile.number + 1];
    Rays rays[OWN_BLOCKS];
    Sample samples[OWN_BLOCKS];
    ints inside[OWN_BLOCKS];
    uint counts[OWN_BLOCKS * OWN_PIXELS], shown_counts[OWN_BLOCKS * OWN_PIXELS];
    tile_rays(&tile, rays, inside);
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        SAMPLE_BEGIN(samples[own], &tile, own, inside[own])
        for (uint k = 0; k < OWN_PIXELS; k++)
            counts[own * OWN_PIXELS + k] = shown_counts[own * OWN_PIXELS + k] = 0;
    }
    uint rank = 0;  // in the list of those that show
    for (uint i = begin; i < end; i++) {
        const Point point = POINT_OF(point_record, (uint)pair_key[i]);
        const bool shows_at_all =
            rank < tile_shown[tile.number] && (uint)shown[begin + rank] == (uint)pair_key[i];
        const uint blocks = blocks_of(&point, &tile);
        for (uint own = 0; own < OWN_BLOCKS; own++) {
            const Coverage at = coverage_at(rays + own, &point);
            const ints is_touched = (ints)(-(int)(blocks >> BLOCK(own) & 1));
            const ints covers = at.covers & is_touched & inside[own];
            floats b = 0.0f;
            ints shows = 0;
            if (shows_at_all && shown[begin + rank] >> (32 + BLOCK(own)) & 1)
                b = weigh(samples + own, &rule, &point, &at, rank, &shows);
            const floats none = 0.0f, one = 1.0f;
            float covered[OWN_PIXELS], weight[OWN_PIXELS], seen[OWN_PIXELS], falloff[OWN_PIXELS];
            sum_pixels(select(none, one, covers), covered);
            sum_pixels(select(none, one, shows & covers), seen);
            sum_pixels(b, weight);
            sum_pixels(select(none, at.falloff, covers), falloff);
            FOR_PIXELS(k) {
                const uint q = pixel_of(&tile, own, k);
                if (q == NONE || covered[OF_PIXEL(k)] == 0.0f) continue;
                const bool is_shown = seen[OF_PIXEL(k)] > 0.0f;
                const uint place = counts[own * OWN_PIXELS + OF_PIXEL(k)]++;
                shown_counts[own * OWN_PIXELS + OF_PIXEL(k)] += is_shown;
                if (!is_listed) continue;
                const uint fragment = pixel_offset[q] + place;
                fragment_point[fragment] = (uint)pair_key[i];
                fragment_falloff[fragment] = falloff[OF_PIXEL(k)] / covered[OF_PIXEL(k)];
                fragment_weight[fragment] = weight[OF_PIXEL(k)] / SAMPLES;
                fragment_shows[fragment] = is_shown;
            }
        }
        if (shows_at_all) rank++;
    }
    for (uint own = 0; own < OWN_BLOCKS; own++)
        FOR_PIXELS(k) {
            const uint q = pixel_of(&tile, own, k);
            if (q == NONE) continue;
            pixel_count[q] = counts[own * OWN_PIXELS + OF_PIXEL(k)];
            pixel_shown[q] = shown_counts[own * OWN_PIXELS + OF_PIXEL(k)];
        }
}
