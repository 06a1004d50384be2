// Each point's highest blend weight in an image, by which it is pruned, for views without gradients.
#include "raster/compositing.h"

// GROUP work-items per tile: read the points that show, nearest first, write the sums of their weights
// in the tile's samples, as shares of a pixel.
kernel void pair_weights(
    const uint tiles,                  //
    const float limit,                 // early_stop, or 1 / gamma
    global const float *camera,        // (21) camera.h, of the samples
    global const uint *point_record,   // (N, RECORD) footprint.h
    global const uint *point_offset,   // (N+1) first pair of each point
    global const uint *tile_offset,    // (TILES+1)
    global const ulong *shown,         // (P) blocks << 32 | point, by tile
    global const uint *tile_shown,     // (TILES)
    global const float *sample_state,  // (2, ?, 16) M, 1/D; NULL without SOFTMAX
    global const int *sample_end,      // (?, 16) NULL alike
    global float *pair_weight)         // (P) cleared before
{
    SHARED_LIST
    SHARED(float, shared, GROUP);
    if (GROUP_ID >= tiles) return;
    const Tile tile = tile_load(camera, GROUP_ID);
    const Rule rule = rule_of(&tile.cam, limit);
    const uint begin = tile_offset[tile.number], end = begin + tile_shown[tile.number];
    Rays rays[OWN_BLOCKS];
    Sample samples[OWN_BLOCKS];
    ints inside[OWN_BLOCKS];
    tile_rays(&tile, rays, inside);
    for (uint own = 0; own < OWN_BLOCKS; own++) {
        SAMPLE_BEGIN(samples[own], &tile, own, inside[own])
    }
    for (uint first = begin, batch; first < end; first += batch) {
        batch = BATCH(end - first);
        READ_BATCH(shown[first + k])
        for (uint k = 0; k < batch; k++) {
            const ulong entry = ENTRY(shown[first + k]);
            const Point point = POINT(entry);
            floats of_pair = 0.0f;
            FOR_BLOCKS(own, (uint)(entry >> 32)) {
                const Coverage at = coverage_at(rays + own, &point);
                ints shows;
                of_pair += weigh(samples + own, &rule, &point, &at, first + k - begin, &shows);
            }
            const float sum = group_sum(SUM_LANES(of_pair), shared) / SAMPLES;
            if (MEMBER == 0 && entry >> 32)
                pair_weight[pair_of(&point, &tile, point_offset[(uint)entry])] = sum;
        }
    }
}
