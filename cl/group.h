// Sums and scans by work-items that share local memory: GROUP neighbours, a power of two on GPUs; 1
// on CPUs, where nothing is shared (pp_cl/engine/device/launch.py). A work-group holds one or more of them
// as a whole, and all its work-items call these functions together.
#ifndef PP_GROUP_H
#define PP_GROUP_H

#include "common.h"

#ifndef GROUP
#define GROUP 1
#endif

// Which of them a work-item is, and their number
#define MEMBER ((uint)get_global_id(0) % GROUP)
#define GROUP_ID ((uint)get_global_id(0) / GROUP)

#if GROUP > 1
#include "gpu/group.h"
#else
// One work-item: the sum is its own value, and no member is before it.
#define GROUP_BARRIER
#define SHARED(T, name, items)
#define group_sum(value, shared) (value)
#define group_sum4(value, shared) (value)
#define group_scan(value, shared, total) (*(total) = (value), 0u)
#endif

#endif
