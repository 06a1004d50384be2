// Lists of the keys of each pixel on GPUs: one work-item per key writes it into the list, and finds
// its place among the others of its run, then of runs of runs.
#include "common.h"

#ifndef RUN
#define RUN 64  // keys ranked at once by comparing all with all; longer lists are merged
#endif

// One work-item per pair: writes its key into the list of its pixel, at the place that pairs.cl found
// for it. Bits of floats >= 0 sort like the floats.
kernel void pairs_scatter(
    const uint p,                     // capacity, in pairs
    const uint hw,                    // pixels
    global const uint *pair_pixel,    // (P)
    global const uint *pixel_offset,  // (HW+1) first key of each pixel
    global const ulong *point_key,    // (P) depth << 32 | place, by point
    global ulong *pair_key)           // (P) depth << 32 | pair, by pixel
{
    const uint pair = get_global_id(0);
    if (pair >= p || pair >= pixel_offset[hw]) return;
    const ulong key = point_key[pair];
    pair_key[pixel_offset[pair_pixel[pair]] + (uint)key] = upsample((uint)(key >> 32), pair);
}

// One work-item per key: writes it at its place within its run, RUN keys of its pixel.
kernel void pairs_sort_runs(
    const uint p,                     // capacity, in pairs
    const uint hw,                    // pixels
    global const uint *pair_pixel,    // (P)
    global const uint *pixel_offset,  // (HW+1)
    global const ulong *pair_key,     // (P) by pixel
    global ulong *sorted)             // (P) the same, each run sorted
{
    const uint i = get_global_id(0);
    if (i >= p || i >= pixel_offset[hw]) return;
    const ulong key = pair_key[i];
    const uint pixel = pair_pixel[(uint)key], begin = pixel_offset[pixel];
    const uint first = i - (i - begin) % RUN, end = min(first + RUN, pixel_offset[pixel + 1]);
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
    const uint hw,     // pixels
    const uint width,  // keys of a run
    const uint group,  // keys of what becomes one run: a multiple of width, or no list has more
    const uint least,  // keys of the longest lists that are left alone
    global const uint *pair_pixel,    // (P)
    global const uint *pixel_offset,  // (HW+1)
    global const ulong *sorted,       // (P) by pixel, each run sorted
    global ulong *pair_key)           // (P) the same, each group sorted
{
    const uint i = get_global_id(0);
    if (i >= p || i >= pixel_offset[hw]) return;
    const ulong key = sorted[i];
    const uint pixel = pair_pixel[(uint)key], list = pixel_offset[pixel];
    const uint count = pixel_offset[pixel + 1] - list;
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
