// Exclusive prefix sums of uint32. A sum above the largest uint is the largest uint.
#include "scan.h"

// GROUP work-items per block of BLOCK values: read them, write their sum.
kernel void scan_sums(
    const uint n,               // values
    const uint b,               // blocks
    global const uint *values,  // (N)
    global uint *block_sum)     // (?) B
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

// GROUP work-items per block of BLOCK values: read them and the sums of the blocks before, write
// where each value starts; those of the last block also write the total behind them.
kernel void scan_offsets(
    const uint n,                  // values
    const uint b,                  // blocks
    global const uint *values,     // (N)
    global const uint *block_sum,  // (?) B
    global uint *offsets)          // (N+1)
{
    SHARED(uint, shared, 2 * GROUP);
    const uint block = GROUP_ID;
    if (block >= b) return;
    const uint end = min(n, (block + 1) * BLOCK);
    SUM_BEFORE(block, block_sum, shared, before_block)
    ulong sum = before_block;
    for (uint first = block * BLOCK; first < end; first += GROUP) {
        const uint i = first + MEMBER;
        uint total;
        const uint before = group_scan(i < end ? values[i] : 0, shared, &total);
        if (i < end) offsets[i] = min(sum + before, (ulong)UINT_MAX);
        sum += total;
    }
    if (MEMBER == 0 && block == b - 1) offsets[n] = min(sum, (ulong)UINT_MAX);
}
