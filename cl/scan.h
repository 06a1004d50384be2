// Prefix sums of uint32 over blocks of BLOCK values, each by GROUP work-items together: one kernel
// leaves the sum of each block, the next one adds up those before its own. A sum above the largest
// uint is the largest uint.
#ifndef PP_SCAN_H
#define PP_SCAN_H

#include "group.h"

#ifndef BLOCK
#define BLOCK 1024
#endif

// The sum of the blocks before `block`, of all with their number, by GROUP work-items together.
#define SUM_BEFORE(block, block_sum, shared, sum)                                                  \
    uint sum;                                                                                      \
    {                                                                                              \
        ulong part = 0;                                                                            \
        for (uint i = MEMBER; i < (block); i += GROUP)                                             \
            part += (block_sum)[i];                                                                \
        group_scan((uint)min(part, (ulong)UINT_MAX), shared, &sum);                                \
    }

#endif
