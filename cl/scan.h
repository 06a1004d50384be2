// Prefix sums of uint32 over blocks of BLOCK values, each by GROUP work-items together: one kernel
// leaves the sum of each block, the next one adds up those before its own. A sum above the largest
// uint is the largest uint.
#ifndef PP_SCAN_H
#define PP_SCAN_H

#include "group.h"

#ifndef BLOCK
#define BLOCK 1024
#endif

// Sums of blocks: of those before `block`, and of all.
typedef struct {
    uint before, all;
} BlockSums;

// By the work-items of a group. shared: 2 * GROUP values.
#define BLOCK_SUMS(name, block, blocks, block_sum, shared)                                         \
    BlockSums name;                                                                                \
    {                                                                                              \
        ulong before = 0, all = 0;                                                                 \
        for (uint i = MEMBER; i < (blocks); i += GROUP) {                                          \
            const uint sum = (block_sum)[i];                                                       \
            all += sum;                                                                            \
            if (i < (block)) before += sum;                                                        \
        }                                                                                          \
        group_scan((uint)min(before, (ulong)UINT_MAX), shared, &name.before);                      \
        group_scan((uint)min(all, (ulong)UINT_MAX), shared, &name.all);                            \
    }

#endif
