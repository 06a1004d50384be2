// Exclusive prefix sums of uint32, and stream compaction: the indices of non-zero flags. A sum
// above the largest uint is the largest uint.
#include "group.h"

#ifndef BLOCK
#define BLOCK 512  // values that GROUP work-items scan together: a million take two levels
#endif

// GROUP work-items per block of BLOCK values: read them, write their sum.
kernel void scan_sums(
    const uint n,               // values
    const uint b,               // blocks
    global const uint *values,  // (N)
    global uint *block_sum)     // (B)
{
    SHARED(uint, shared, 2 * GROUP);
    const uint block = GROUP_ID;
    if (block >= b) return;
    const uint end = min(n, (block + 1) * BLOCK);
    ulong sum = 0;  // of at most BLOCK values; add_sat would keep CPUs from adding several at once
    uint total;
    for (uint i = block * BLOCK + MEMBER; i < end; i += GROUP)
        sum += values[i];
    group_scan((uint)min(sum, (ulong)UINT_MAX), shared, &total);
    if (MEMBER == 0) block_sum[block] = total;
}

// GROUP work-items per block of BLOCK flags: read them, write how many are not zero.
kernel void count_nonzero(
    const uint n,               // flags
    const uint b,               // blocks
    global const uchar *flags,  // (N)
    global uint *block_sum)     // (B)
{
    SHARED(uint, shared, 2 * GROUP);
    const uint block = GROUP_ID;
    if (block >= b) return;
    const uint end = min(n, (block + 1) * BLOCK);
    uint count = 0, total;
    for (uint i = block * BLOCK + MEMBER; i < end; i += GROUP)
        count += flags[i] != 0;
    group_scan(count, shared, &total);
    if (MEMBER == 0) block_sum[block] = total;
}

// GROUP work-items per block of BLOCK values: read them and where the block starts, write where
// each value starts; those of the last block also write the total behind them.
kernel void scan_offsets(
    const uint n,                     // values
    const uint b,                     // blocks
    global const uint *values,        // (N)
    global const uint *block_offset,  // (B+1)
    global uint *offsets)             // (N+1)
{
    SHARED(uint, shared, 2 * GROUP);
    const uint block = GROUP_ID;
    if (block >= b) return;
    const uint end = min(n, (block + 1) * BLOCK);
    uint sum = block_offset[block];
    for (uint first = block * BLOCK; first < end; first += GROUP) {
        const uint i = first + MEMBER;
        uint total;
        const uint before = group_scan(i < end ? values[i] : 0, shared, &total);
        if (i < end) offsets[i] = add_sat(sum, before);
        sum = add_sat(sum, total);
    }
    if (MEMBER == 0 && block == b - 1) offsets[n] = sum;
}

// GROUP work-items per block of BLOCK flags: read them and how many before the block are not zero,
// write the indices of those that are not, and the place of each among these.
kernel void scan_nonzero(
    const uint n,                     // flags
    const uint b,                     // blocks
    global const uchar *flags,        // (N)
    global const uint *block_offset,  // (B+1) prefix sums of what count_nonzero wrote
    global uint *indices,             // (N); the first block_offset[b] are written
    global uint *places)              // (N); not written where the flag is zero
{
    SHARED(uint, shared, 2 * GROUP);
    const uint block = GROUP_ID;
    if (block >= b) return;
    const uint end = min(n, (block + 1) * BLOCK);
    uint listed = block_offset[block];
    for (uint first = block * BLOCK; first < end; first += GROUP) {
        const uint i = first + MEMBER, found = i < end && flags[i] != 0;
        uint total;
        const uint before = group_scan(found, shared, &total);
        if (found) {
            indices[listed + before] = i;
            places[i] = listed + before;
        }
        listed += total;
    }
}
