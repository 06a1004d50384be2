// Stream compaction: the indices of non-zero flags.
#include "scan.h"

// GROUP work-items per block of BLOCK flags: read them, write how many are not zero.
kernel void count_nonzero(
    const uint n,               // flags
    const uint b,               // blocks
    global const uchar *flags,  // (N)
    global uint *block_sum)     // (?) B
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

// GROUP work-items per block of BLOCK flags: read them and how many of each block before are not
// zero, write the indices of those that are not, and the place of each among these; those of the
// last block also write how many.
kernel void scan_nonzero(
    const uint n,                  // flags
    const uint b,                  // blocks
    global const uchar *flags,     // (N)
    global const uint *block_sum,  // (?) B of count_nonzero
    global uint *indices,          // (N); the first `found` are written
    global uint *places,           // (N); not written where the flag is zero
    global uint *found)            // (1)
{
    SHARED(uint, shared, 2 * GROUP);
    const uint block = GROUP_ID;
    if (block >= b) return;
    const uint end = min(n, (block + 1) * BLOCK);
    SUM_BEFORE(block, block_sum, shared, listed)
    for (uint first = block * BLOCK; first < end; first += GROUP) {
        const uint i = first + MEMBER, is_listed = i < end && flags[i] != 0;
        uint total;
        const uint before = group_scan(is_listed, shared, &total);
        if (is_listed) {
            indices[listed + before] = i;
            places[i] = listed + before;
        }
        listed += total;
    }
    if (MEMBER == 0 && block == b - 1) *found = listed;
}
