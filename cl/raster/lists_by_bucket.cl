// Lists of the keys of each pixel on CPUs, where an atomic addition takes as long as the rest of a
// pair: the keys go into buckets, one for each stretch of the image, whose lists a core's cache
// holds.
#include "common.h"

#define RUN 128  // keys ranked at once by comparing all with all; longer lists are merged
#define FEW 6    // keys of a list that are sorted fastest one by one

#ifndef BUCKETS
#define BUCKETS 256  // at most, of a power of two of pixels each
#endif

// Of `total` pairs, the first one of a chunk.
#define CHUNK_START(chunk) ((uint)((ulong)total * (chunk) / chunks))

// One work-item per chunk: reads the pixels of its pairs, writes how many each bucket has of them.
kernel void pairs_bucket_sizes(
    const uint n,                     // points
    const uint p,                     // capacity, in pairs
    const uint chunks,                // of the pairs
    const uint stretch,               // log2 of the pixels of a bucket
    global const uint *point_offset,  // (N+1)
    global const uint *pair_pixel,    // (P)
    global uint *bucket_size)         // (?) of each bucket, by chunk
{
    const uint chunk = get_global_id(0), total = point_offset[n] > p ? 0 : point_offset[n];
    if (chunk >= chunks) return;
    uint size[BUCKETS] = {0};
    for (uint pair = CHUNK_START(chunk); pair < CHUNK_START(chunk + 1); pair++)
        size[pair_pixel[pair] >> stretch]++;
    for (uint bucket = 0; bucket < BUCKETS; bucket++)
        bucket_size[bucket * chunks + chunk] = size[bucket];
}

// One work-item per chunk: writes the keys of its pairs into their buckets, behind those of the
// chunks before.
kernel void pairs_bucket(
    const uint n,                     // points
    const uint p,                     // capacity, in pairs
    const uint chunks,                // of the pairs
    const uint stretch,               // log2 of the pixels of a bucket
    global const uint *point_offset,  // (N+1)
    global const uint *pair_pixel,    // (P)
    global const ulong *point_key,    // (P) depth << 32 | pair, by point
    global const uint *bucket_size,   // (?) of each bucket, by chunk
    global ulong *bucket_key)         // (P) the same, by bucket, there by point
{
    const uint chunk = get_global_id(0), total = point_offset[n] > p ? 0 : point_offset[n];
    if (chunk >= chunks) return;
    uint next[BUCKETS], start = 0;
    for (uint i = 0; i < BUCKETS * chunks; i++) {
        if (i % chunks == chunk) next[i / chunks] = start;
        start += bucket_size[i];
    }
    for (uint pair = CHUNK_START(chunk); pair < CHUNK_START(chunk + 1); pair++)
        bucket_key[next[pair_pixel[pair] >> stretch]++] = point_key[pair];
}

// Minus the number of depths in [first, end) that are smaller than each of z. A function of
// vectors: else PoCL splits them.
ALWAYS_INLINE int16 smaller(const uint16 z, const uint *depth, const uint first, const uint end) {
    int16 found = 0;
    for (uint j = first; j < end; j++)
        found += (uint16)(depth[j]) < z;
    return found;
}

// Sorts `count` <= RUN keys, which are ordered by pair, into `sorted`, which may be the same
// memory: each key's place is the number of smaller depths, and of equal ones before it.
static inline void sort_run(global const ulong *keys, const uint count, global ulong *sorted) {
    const uint16 lane = (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    ulong run[RUN];
    uint depth[RUN + 16];
    for (uint i = 0; i < count; i++) {
        run[i] = keys[i];
        depth[i] = (uint)(run[i] >> 32);
    }
    vstore16((uint16)(0), 0, depth + count);  // the lanes behind the last one
    for (uint i = 0; i < count; i += 16) {
        const uint16 z = vload16(0, depth + i);
        const uint end = min(i + 16, count);
        // of equal ones those before it are smaller by the least step
        int16 place = smaller(z + 1, depth, 0, i) + smaller(z, depth, end, count);
        for (uint j = i; j < end; j++)
            place += (uint16)(depth[j]) < z + select((uint16)(0), (uint16)(1), lane > j - i);
        int places[16];
        vstore16(place, 0, places);
        for (uint j = i; j < end; j++)
            sorted[-places[j - i]] = run[j];
    }
}

// Merges two sorted neighbours, [0, middle) and [middle, count) of `keys`, into `merged`.
static inline void
merge(global const ulong *keys, const uint middle, const uint count, global ulong *merged) {
    uint a = 0, b = middle;
    for (uint i = 0; i < count; i++) {
        const int first = b >= count || (a < middle && keys[a] < keys[b]);
        merged[i] = first ? keys[a++] : keys[b++];
    }
}

// Sorts `count` keys, which are ordered by pair, in place. other: memory for as many.
static inline void sort_list(global ulong *keys, const uint count, global ulong *other) {
    if (count <= FEW) {
        for (uint i = 1; i < count; i++) {
            const ulong key = keys[i];
            uint j = i;
            for (; j > 0 && keys[j - 1] > key; j--)
                keys[j] = keys[j - 1];
            keys[j] = key;
        }
        return;
    }
    uint passes = 0;
    for (uint width = RUN; width < count; width *= 2)
        passes++;
    // so that the last pass ends in `keys`
    global ulong *from = keys, *to = passes % 2 ? other : keys;
    for (uint first = 0; first < count; first += RUN)
        sort_run(from + first, min((uint)RUN, count - first), to + first);
    for (uint width = RUN; width < count; width *= 2) {
        from = to;
        to = from == keys ? other : keys;
        for (uint first = 0; first < count; first += 2 * width)
            merge(
                from + first, min(width, count - first), min(2 * width, count - first), to + first);
    }
}

// One work-item per bucket: reads its keys, writes those of each of its pixels, sorted, and where
// they start.
kernel void pairs_list(
    const uint hw,                   // pixels
    const uint chunks,               // of the pairs
    const uint stretch,              // log2 of the pixels of a bucket
    global const uint *bucket_size,  // (?) of each bucket, by chunk
    global const uint *pair_pixel,   // (P)
    global ulong *bucket_key,        // (P) by bucket; overwritten
    global uint *pixel_offset,       // (HW+1)
    global ulong *pair_key)          // (P) by pixel
{
    const uint bucket = get_global_id(0), first = bucket << stretch;
    if (bucket >= BUCKETS || first >= hw) return;
    const uint last = min(first + (1u << stretch), hw);
    uint begin = 0, end = 0;
    for (uint i = 0; i < (bucket + 1) * chunks; i++) {
        if (i == bucket * chunks) begin = end;
        end += bucket_size[i];
    }
    // of each pixel: how many keys it has, where they start, where the next one belongs
    for (uint q = first; q < last; q++)
        pixel_offset[q] = 0;
    for (uint i = begin; i < end; i++)
        pixel_offset[pair_pixel[(uint)bucket_key[i]]]++;
    uint start = begin;
    for (uint q = first; q < last; q++) {
        const uint count = pixel_offset[q];
        pixel_offset[q] = start;
        start += count;
    }
    for (uint i = begin; i < end; i++)
        pair_key[pixel_offset[pair_pixel[(uint)bucket_key[i]]]++] = bucket_key[i];
    start = begin;
    for (uint q = first; q < last; q++) {
        const uint behind = pixel_offset[q];
        pixel_offset[q] = start;
        sort_list(pair_key + start, behind - start, bucket_key + start);
        start = behind;
    }
    if (last == hw) pixel_offset[hw] = end;
}
