// Exclusive prefix sums of uint32, and the list of the non-zero entries. A sum above the largest
// uint is the largest uint.
#include "group.h"

#ifndef FLAGS
#define FLAGS 0  // 1: every non-zero value counts as one
#endif
#ifndef BLOCK
#define BLOCK 512  // values that GROUP work-items scan together: a million take two levels
#endif

static inline uint scan_value(const uint value) {
    return FLAGS ? (value != 0) : value;
}

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
    uint sum = 0, total;
    for (uint i = block * BLOCK + MEMBER; i < end; i += GROUP)
        sum = add_sat(sum, scan_value(values[i]));
    group_scan(sum, shared, &total);
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
        const uint before = group_scan(i < end ? scan_value(values[i]) : 0, shared, &total);
        if (i < end) offsets[i] = add_sat(sum, before);
        sum = add_sat(sum, total);
    }
    if (MEMBER == 0 && block == b - 1) offsets[n] = sum;
}

// GROUP work-items per block of BLOCK values: read them and how many before the block are not zero,
// write the indices of those that are not.
kernel void scan_nonzero(
    const uint n,                     // values
    const uint b,                     // blocks
    global const uint *values,        // (N)
    global const uint *block_offset,  // (B+1) from scan_sums with FLAGS = 1
    global uint *indices)             // (N); the first block_offset[b] are written
{
    SHARED(uint, shared, 2 * GROUP);
    const uint block = GROUP_ID;
    if (block >= b) return;
    const uint end = min(n, (block + 1) * BLOCK);
    uint listed = block_offset[block];
    for (uint first = block * BLOCK; first < end; first += GROUP) {
        const uint i = first + MEMBER, found = i < end && values[i] != 0;
        uint total;
        const uint before = group_scan(found, shared, &total);
        if (found) indices[listed + before] = i;
        listed += total;
    }
}
