// What the kernels of weights.cl and softmax.cl share: how they list the points that show.
#ifndef PP_SHOWN_H
#define PP_SHOWN_H

#include "raster/compositing.h"

// The list of the points that show: an entry is blocks << 32 | point. CPUs leave out those without a
// block; on GPUs all members write the entries of a batch.
#if GROUP > 1
#define SHARED_BLOCKS local uint shared_blocks[BATCH_PAIRS], shared_covered[1];
#define BEGIN_BLOCKS                                                                               \
    for (uint k = MEMBER; k < batch; k += GROUP)                                                   \
        shared_blocks[k] = 0;                                                                      \
    if (first == begin && MEMBER == 0) *shared_covered = 0;
#define ADD_BLOCK(own, samples)                                                                    \
    if (any_sample(samples)) atomic_or(shared_blocks + k, 1u << BLOCK(own));
#define END_BLOCKS                                                                                 \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                  \
    for (uint k = MEMBER; k < batch; k += GROUP) {                                                 \
        const uint blocks = shared_blocks[k], point = (uint)shared_entry[k];                       \
        shown[first + k] = upsample(blocks, point);                                                \
        if (blocks) point_is_visible[point] = 1;                                                   \
        atomic_or(shared_covered, blocks);                                                         \
    }
#define END_ENTRY rank++;
#define ALL_COVERED (begin < end ? *shared_covered : 0)
#else
#define SHARED_BLOCKS uint covered = 0;
#define BEGIN_BLOCKS
#define ADD_BLOCK(own, samples) blocks |= any_sample(samples) ? 1u << BLOCK(own) : 0u;
#define END_BLOCKS
#define END_ENTRY                                                                                  \
    if (blocks) {                                                                                  \
        shown[begin + rank++] = upsample(blocks, (uint)key);                                       \
        point_is_visible[(uint)key] = 1; /* tiles share points, so some write the same 1 */        \
        covered |= blocks;                                                                         \
    }
#define ALL_COVERED covered
#endif

// Flags of the parts of 4 x 4 pixels in which any of these blocks lies.
ALWAYS_INLINE void store_covered(const Tile *tile, const uint blocks, global int *is_covered) {
    const int columns = (tile->width + 3) / 4, rows = (tile->height + 3) / 4;
    for (int part = MEMBER; part < COVERED * COVERED; part += GROUP) {
        const uint bits = SAMPLES == 4 ? blocks >> 4 * part & 15 : blocks >> part & 1;
        const int number = SAMPLES == 4 ? 4 * part : part;  // of its first block
        const int x = (tile->x + BLOCK_X(number)) / 4, y = (tile->y + BLOCK_Y(number)) / 4;
        if (x < columns && y < rows) is_covered[y * columns + x] = bits != 0;
    }
}

#endif
