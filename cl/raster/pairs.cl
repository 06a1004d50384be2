// Pairs: every hit of a point in a pixel. pairs_fill writes them point by point; then a key (depth <<
// 32 | pair) of each is written into the list of its pixel, and the lists are sorted by depth, then
// by pair and so by point.
//
// On GPUs, pairs_fill finds the place of a pair in its list by counting those of the pixel, and
// pairs_scatter writes its key there. On CPUs, where an atomic addition takes as long as the rest of
// a pair, pairs_bucket_sizes and pairs_bucket write the keys into buckets, one for each stretch of
// the image, and pairs_list makes lists of a bucket, which its core's cache holds.
#include "common.h"
#include "raster/footprint.h"

#ifndef RUN
#define RUN 64  // keys ranked at once by comparing all with all; longer lists are merged
#endif

#define FEW 6  // keys of a list that are sorted fastest one by one

// Pixels of a box that are tested before their hits are written, at most 32 (bits of a uint). With
// fewer, writing alternates more often between the pairs of 16 points, which lie far apart.
#define CELLS (LANES > 1 ? 32 : 1)

// The place of a pair in the list of its pixel, on GPUs.
#define PLACE(pixel) (LANES > 1 ? 0u : atomic_inc(&pixel_count[pixel]))

#ifndef BUCKETS
#define BUCKETS 256  // at most, of a power of two of pixels each
#endif

// Of `total` pairs, the first one of a chunk.
#define CHUNK_START(chunk) ((uint)((ulong)total * (chunk) / chunks))

// Reads the footprints of the points from `first` on, of which `count` exist; the others have empty
// boxes.
ALWAYS_INLINE Footprints footprints_load(
    const Camera *cam,
    const uint first,
    const uint count,
    global const float *point_radius,
    global const float4 *point_camera,
    global const ushort4 *point_box,
    global const float4 *point_white) {
    Footprints f;
    float place[4][LANES], radius[LANES];
    for (uint j = 0; j < LANES; j++) {
        const uint i = first + min(j, count - 1);
        const float4 at = point_camera[i];
        const int4 box = j < count ? convert_int4(point_box[i]) : (int4)(1, 1, 0, 0);
        place[0][j] = at.x;
        place[1][j] = at.y;
        place[2][j] = at.z;
        place[3][j] = at.w;
        radius[j] = point_radius[i];
        f.box[0][j] = box.x;
        f.box[1][j] = box.y;
        f.box[2][j] = box.z;
        f.box[3][j] = box.w;
    }
    f.x = LANES_FROM(place[0]);
    f.y = LANES_FROM(place[1]);
    f.z = LANES_FROM(place[2]);
    f.t = LANES_FROM(place[3]);
    f.radius = LANES_FROM(radius);
#if FOOTPRINT == GAUSSIAN
    for (uint j = 0; j < LANES; j++) {
        const float4 white = point_white[first + min(j, count - 1)];
        place[0][j] = white.x;
        place[1][j] = white.y;
        place[2][j] = white.z;
        place[3][j] = white.w;
    }
    for (uint k = 0; k < 4; k++)
        f.white[k] = LANES_FROM(place[k]);
#endif
    footprints_prepare(cam, &f);
    return f;
}

// One work-item per LANES points: finds their hits again (project.cl counted them), writes them as
// pairs and, on GPUs, counts them at their pixels; does nothing where not all pairs have room.
//
// A compiler that rounds otherwise here than in project.cl finds one hit more or less of a point in
// a million: one too many is left out, one that is missing becomes a pair without weight.
kernel void pairs_fill(
    const uint n,                        // points
    const uint p,                        // pairs for which there is room
    global const float *camera,          // (21) camera.h
    global const float *point_radius,    // (N)
    global const float4 *point_camera,   // (N, 4) x, y, z, t
    global const ushort4 *point_box,     // (N, 4) first x, first y, last x, last y
    global const float4 *point_white,    // (?, 4) (N, 4) Footprints.white of Gaussians; else unread
    global const uint *point_offset,     // (N+1) first pair of each point
    global uint *pair_pixel,             // (P)
    global uint2 *pair_point_closeness,  // (P, 2) point, bits of d in [0, 1]
    global ulong *pair_place,            // (P) depth << 32 | place in the list of the pixel, or 0
    global volatile uint *pixel_count)   // (HW) accumulates, not touched on CPUs
{
    const uint first = get_global_id(0) * LANES;
    if (first >= n || point_offset[n] > p) return;
    const uint count = min((uint)LANES, n - first);
    if (point_offset[first] == point_offset[first + count]) return;
    const Camera cam = camera_load(camera);
    const Footprints f =
        footprints_load(&cam, first, count, point_radius, point_camera, point_box, point_white);
    // of each point: its next pair, where they end, the first pixel of its box
    uint next[LANES], end[LANES], corner[LANES];
    for (uint j = 0; j < count; j++) {
        next[j] = point_offset[first + j];
        end[j] = point_offset[first + j + 1];
        corner[j] = f.box[1][j] * cam.width + f.box[0][j];
    }
    int row = 0, column = 0;
    while (row < f.rows) {
        // first a few pixels of all points, then what each point hit: its pairs lie together
        float closeness[CELLS][LANES], depth[CELLS][LANES];
        uint offset[CELLS], hits[LANES];
        uints found = 0;
        for (uint k = 0; k < CELLS && row < f.rows; k++) {
            floats d, z;
            const ints hit = footprints_hit(&cam, &f, column, row, &d, &z);
            found |= select((uints)(0), (uints)(1u << k), hit);
            LANES_INTO(closeness[k], d);
            LANES_INTO(depth[k], z);
            offset[k] = row * cam.width + column;
            if (++column == f.columns) {
                column = 0;
                row++;
            }
        }
        LANES_INTO(hits, found);
        for (uint j = 0; j < count; j++)
            for (uint left = hits[j]; left && next[j] < end[j]; left &= left - 1) {
                const uint k = 31 - clz(left & -left), pair = next[j]++;
                const uint pixel = corner[j] + offset[k];
                pair_pixel[pair] = pixel;
                pair_point_closeness[pair] = (uint2)(first + j, as_uint(closeness[k][j]));
                pair_place[pair] = upsample(as_uint(depth[k][j]), PLACE(pixel));
            }
    }
    for (uint j = 0; j < count; j++)
        for (uint pair = next[j]; pair < end[j]; pair++) {
            const float depth = point_camera[first + j].w;
            pair_pixel[pair] = corner[j];
            pair_point_closeness[pair] = (uint2)(first + j, as_uint(0.0f));
            pair_place[pair] = upsample(as_uint(depth), PLACE(corner[j]));
        }
}

// One work-item per chunk: reads the pixels of its pairs, writes how many each bucket has of them.
kernel void pairs_bucket_sizes(
    const uint n,                     // points
    const uint p,                     // pairs for which there is room
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
    const uint p,                     // pairs for which there is room
    const uint chunks,                // of the pairs
    const uint stretch,               // log2 of the pixels of a bucket
    global const uint *point_offset,  // (N+1)
    global const uint *pair_pixel,    // (P)
    global const ulong *pair_place,   // (P) depth << 32
    global const uint *bucket_size,   // (?) of each bucket, by chunk
    global ulong *bucket_key)         // (P) depth << 32 | pair, by bucket, there by pair
{
    const uint chunk = get_global_id(0), total = point_offset[n] > p ? 0 : point_offset[n];
    if (chunk >= chunks) return;
    uint next[BUCKETS], start = 0;
    for (uint i = 0; i < BUCKETS * chunks; i++) {
        if (i % chunks == chunk) next[i / chunks] = start;
        start += bucket_size[i];
    }
    for (uint pair = CHUNK_START(chunk); pair < CHUNK_START(chunk + 1); pair++)
        bucket_key[next[pair_pixel[pair] >> stretch]++] = pair_place[pair] | pair;
}

// Minus the number of depths in [first, end) that are smaller than each of z. A function of vectors:
// else PoCL splits them.
ALWAYS_INLINE int16 smaller(const uint16 z, const uint *depth, const uint first, const uint end) {
    int16 found = 0;
    for (uint j = first; j < end; j++)
        found += (uint16)(depth[j]) < z;
    return found;
}

// Sorts `count` <= RUN keys, which are ordered by pair, into `sorted`, which may be the same memory:
// each key's place is the number of smaller depths, and of equal ones before it.
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

// One work-item per pair, on GPUs: writes its key at its place. Bits of floats >= 0 sort like the floats.
kernel void pairs_scatter(
    const uint p,                     // pairs for which there is room
    const uint hw,                    // pixels
    global const uint *pair_pixel,    // (P)
    global const ulong *pair_place,   // (P) depth << 32 | place in the list of the pixel
    global const uint *pixel_offset,  // (HW+1) first key of each pixel
    global ulong *pair_key)           // (P) depth << 32 | pair, by pixel
{
    const uint pair = get_global_id(0);
    if (pair >= p || pair >= pixel_offset[hw]) return;
    const ulong place = pair_place[pair];
    pair_key[pixel_offset[pair_pixel[pair]] + (uint)place] = upsample((uint)(place >> 32), pair);
}

// One work-item per key: writes it at its place within its run, RUN keys of its pixel.
kernel void pairs_sort_runs(
    const uint p,                     // pairs for which there is room
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
    const uint p,      // pairs for which there is room
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
