// Sorts the keys of each tile's list on GPUs: one work-item per key finds its place among the others
// of its run, then of runs of runs.
#include "common.h"

#ifndef RUN
#define RUN 64  // keys ranked at once by comparing all with all; longer lists are merged
#endif

// One work-item per key: writes it at its place within its run, RUN keys of its tile.
kernel void pairs_sort_runs(
    const uint p,                    // capacity, in pairs
    const uint tiles,                //
    global const uint *pair_tile,    // (P) of each place in the lists
    global const uint *tile_offset,  // (TILES+1) first pair of each tile
    global const ulong *pair_key,    // (P) by tile
    global ulong *sorted)            // (P) the same, each run sorted
{
    const uint i = get_global_id(0);
    if (tile_offset[tiles] > p || i >= tile_offset[tiles]) return;
    const ulong key = pair_key[i];
    const uint tile = pair_tile[i], begin = tile_offset[tile];
    const uint first = i - (i - begin) % RUN, end = min(first + RUN, tile_offset[tile + 1]);
    uint place = first;
    for (uint j = first; j < end; j++)
        place += pair_key[j] < key;
    sorted[place] = key;
}

// One work-item per key of a list of more than `least` keys: writes it at its place in its group,
// the sorted runs of `width` keys that follow one another in `group` keys of its list. That place
// is behind the smaller keys of all of the group's runs.
kernel void pairs_merge_runs(
    const uint p,      // capacity, in pairs
    const uint tiles,  //
    const uint width,  // keys of a run
    const uint group,  // keys of what becomes one run: a multiple of width, or no list has more
    const uint least,  // keys of the longest lists that are left alone
    global const uint *pair_tile,    // (P) of each place in the lists
    global const uint *tile_offset,  // (TILES+1) first pair of each tile
    global const ulong *sorted,      // (P) by tile, each run sorted
    global ulong *pair_key)          // (P) the same, each group sorted
{
    const uint i = get_global_id(0);
    if (tile_offset[tiles] > p || i >= tile_offset[tiles]) return;
    const ulong key = sorted[i];
    const uint tile = pair_tile[i], list = tile_offset[tile];
    const uint count = tile_offset[tile + 1] - list;
    if (count <= least) return;
    const uint skipped = (i - list) / group * group;
    const uint begin = list + skipped, end = begin + min(group, count - skipped);
    const uint own = i - (i - begin) % width;
    uint place = begin + i - own;
    for (uint first = begin; first < end; first += width) {
        if (first == own) continue;
        uint low = first, high = min(first + width, end);  // the smaller ones end between them
        while (low < high) {
            const uint middle = low + (high - low) / 2;  // their sum may pass 2^32
            if (sorted[middle] < key)
                low = middle + 1;
            else
                high = middle;
        }
        place += low - first;
    }
    pair_key[place] = key;
}
