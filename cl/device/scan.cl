// Exclusive prefix sums of uint32, and the list of the non-zero entries. A sum above the largest
// uint is the largest uint.
#include "common.h"

#ifndef FLAGS
#define FLAGS 0  // 1: every non-zero value counts as one
#endif
#ifndef BLOCK
#define BLOCK 512  // values per work-item: a million values take two levels
#endif

static inline uint scan_value(const uint value) {
    return FLAGS ? (value != 0) : value;
}

// One work-item per block of BLOCK values: reads them, writes their sum.
kernel void scan_sums(
    const uint n,               // values
    const uint b,               // blocks
    global const uint *values,  // (N)
    global uint *block_sum)     // (B)
{
    const uint block = get_global_id(0);
    if (block >= b) return;
    const uint end = min(n, (block + 1) * BLOCK);
    uint sum = 0;
    for (uint i = block * BLOCK; i < end; i++)
        sum = add_sat(sum, scan_value(values[i]));
    block_sum[block] = sum;
}

// One work-item per block of BLOCK values: reads them and where the block starts, writes where each
// value starts; the last block also writes the total behind them.
kernel void scan_offsets(
    const uint n,                     // values
    const uint b,                     // blocks
    global const uint *values,        // (N)
    global const uint *block_offset,  // (B+1)
    global uint *offsets)             // (N+1)
{
    const uint block = get_global_id(0);
    if (block >= b) return;
    const uint end = min(n, (block + 1) * BLOCK);
    uint sum = block_offset[block];
    for (uint i = block * BLOCK; i < end; i++) {
        offsets[i] = sum;
        sum = add_sat(sum, scan_value(values[i]));
    }
    if (block == b - 1) offsets[n] = sum;
}

// One work-item per value: reads it and its number among the non-zero ones, writes its index there
// if it is non-zero.
kernel void scan_nonzero(
    const uint n,                // values
    global const uint *values,   // (N)
    global const uint *offsets,  // (N+1) from scan_offsets with FLAGS = 1
    global uint *indices)        // (N); the first offsets[n] are written
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    if (values[i]) indices[offsets[i]] = i;
}
