// Pairs of a point and a tile that its box touches, in one list for each tile, as keys (depth << 32 |
// point) that are sorted by depth, then by point. Bits of floats >= 0 sort like the floats.
//
// CPUs count and write chunk by chunk of the points, each chunk behind those before it, so that
// points ascend in a list, and sort each list by depth. On GPUs each point counts and writes by
// itself, in any order, and lists_by_key.cl sorts the keys.
#include "common.h"
#include "raster/footprint.h"
#include "scan.h"

#define DIGITS 256  // of a radix sort
#define FEW 24      // keys of a list that are sorted fastest one by one

#if ON_CPU
#define UNITS ((n + BLOCK - 1) / BLOCK)  // blocks of points, of which chunks are made
#define FIRST_POINT(unit) min(n, (unit) * BLOCK)
#define IS_EMPTY(unit) (block_sum[unit] == 0)  // most blocks of a crop
#define ROW(chunk) (chunk)
#define NEXT(counter) ((counter)++)
#else
#define UNITS n
#define FIRST_POINT(unit) (unit)
#define IS_EMPTY(unit) false
#define ROW(chunk) 0
#define NEXT(counter) atomic_inc(&(counter))
#endif

// The first unit of a chunk.
#define FIRST_UNIT(chunk) ((uint)((ulong)UNITS * (chunk) / chunks))

#define FOR_POINTS(i, chunk)                                                                       \
    for (uint unit = FIRST_UNIT(chunk); unit < FIRST_UNIT((chunk) + 1); unit++)                    \
        for (uint i = FIRST_POINT(unit); !IS_EMPTY(unit) && i < FIRST_POINT(unit + 1); i++)

#define FOR_TILES(tile, p)                                                                         \
    for (uint y = (p)->first.y / TILE_SIDE; y <= (p)->last.y / TILE_SIDE; y++)                     \
        for (uint tile = y * columns + (p)->first.x / TILE_SIDE;                                   \
             tile <= y * columns + (p)->last.x / TILE_SIDE; tile++)

// One work-item per chunk: counts the pairs of its points by tile.
kernel void pairs_count(
    const uint n,                     // points
    const uint chunks,                //
    const uint columns,               // of tiles
    const uint tiles,                 //
    global const uint *point_record,  // (N, RECORD) footprint.h
    global const uint *point_count,   // (N) pairs
    global const uint *block_sum,     // ((N+BLOCK-1)/BLOCK) of them
    global volatile uint *tile_next)  // (ROWS, TILES) by chunk on CPUs; cleared before
{
    const uint chunk = get_global_id(0);
    if (chunk >= chunks) return;
    global volatile uint *next = tile_next + (size_t)ROW(chunk) * tiles;
    FOR_POINTS(i, chunk) {
        if (point_count[i] == 0) continue;
        const Point point = POINT_OF(point_record, i);
        FOR_TILES(tile, &point) NEXT(next[tile]);
    }
}

// One work-item per tile: adds up the counts of its rows, and writes in their place where each row
// begins in the tile's list.
kernel void pairs_sum(
    const uint rows,         //
    const uint tiles,        //
    global uint *tile_next,  // (ROWS, TILES)
    global uint *tile_size)  // (TILES)
{
    const uint tile = get_global_id(0);
    if (tile >= tiles) return;
    uint sum = 0;
    for (uint row = 0; row < rows; row++) {
        const size_t at = (size_t)row * tiles + tile;
        const uint own = tile_next[at];
        tile_next[at] = sum;
        sum = add_sat(sum, own);
    }
    tile_size[tile] = sum;
}

// One work-item per chunk: writes the keys of its points into the lists of their tiles, if all have
// room, and counts the view for points that have any.
kernel void pairs_fill(
    const uint n,                     // points
    const uint p,                     // capacity, in pairs
    const uint chunks,                //
    const uint columns,               // of tiles
    const uint tiles,                 //
    const int is_counted,             // 0: times_seen is not touched
    global const uint *point_record,  // (N, RECORD) footprint.h
    global const uint *point_count,   // (N) pairs
    global const uint *block_sum,     // ((N+BLOCK-1)/BLOCK) of them
    global const uint *tile_offset,   // (TILES+1) first pair of each tile
    global volatile uint *tile_next,  // (ROWS, TILES) next place in its list, by chunk; overwritten
    global ulong *pair_key,           // (P) depth << 32 | point, by tile
    global uint *pair_tile,           // (?) (P) alike; written on GPUs
    global float *times_seen)         // (N) accumulates, NULL if not is_counted
{
    const uint chunk = get_global_id(0);
    if (chunk >= chunks || tile_offset[tiles] > p) return;
    global volatile uint *next = tile_next + (size_t)ROW(chunk) * tiles;
    FOR_POINTS(i, chunk) {
        if (point_count[i] == 0) continue;
        if (is_counted) times_seen[i] += 1.0f;
        const Point point = POINT_OF(point_record, i);
        const ulong key = upsample(as_uint(DEPTH(&point)), i);
        FOR_TILES(tile, &point) {
            const uint pair = tile_offset[tile] + NEXT(next[tile]);
            pair_key[pair] = key;
            if (!ON_CPU) pair_tile[pair] = tile;
        }
    }
}

// One work-item per tile, on CPUs: sorts its keys, whose points ascend, by the bits in which their
// depths differ, from the lowest digit on.
kernel void pairs_sort(
    const uint tiles,                //
    const uint p,                    // capacity, in pairs
    global const uint *tile_offset,  // (TILES+1)
    global ulong *pair_key,          // (P) by tile
    global ulong *other)             // (P) overwritten
{
    const uint tile = get_global_id(0);
    if (tile >= tiles || tile_offset[tiles] > p) return;
    const uint begin = tile_offset[tile], count = tile_offset[tile + 1] - begin;
    global ulong *from = pair_key + begin, *to = other + begin;
    if (count <= FEW) {
        for (uint i = 1; i < count; i++) {
            const ulong key = from[i];
            uint j = i;
            for (; j > 0 && from[j - 1] > key; j--)
                from[j] = from[j - 1];
            from[j] = key;
        }
        return;
    }
    uint least = UINT_MAX, most = 0;
    for (uint i = 0; i < count; i++) {
        const uint depth = (uint)(from[i] >> 32);
        least = min(least, depth);
        most = max(most, depth);
    }
    const uint bits = 32 - clz(most - least), passes = (bits + 7) / 8;
    const uint digit = passes ? (bits + passes - 1) / passes : 0, all = (1u << digit) - 1;
    for (uint shift = 0; shift < bits; shift += digit) {
        uint start[DIGITS];
        for (uint i = 0; i <= all; i++)
            start[i] = 0;
        for (uint i = 0; i < count; i++)
            start[((uint)(from[i] >> 32) - least) >> shift & all]++;
        uint sum = 0;
        for (uint i = 0; i <= all; i++) {
            const uint own = start[i];
            start[i] = sum;
            sum += own;
        }
        for (uint i = 0; i < count; i++) {
            const ulong key = from[i];
            to[start[((uint)(key >> 32) - least) >> shift & all]++] = key;
        }
        global ulong *const sorted = to;
        to = from;
        from = sorted;
    }
    for (uint i = 0; from != pair_key + begin && i < count; i++)
        pair_key[begin + i] = from[i];
}
