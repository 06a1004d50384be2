// Vectors of LANES neighbouring values, which one work-item handles: 16 on CPUs, 4 or 1 on GPUs
// (pp_cl/engine/device/launch.py). The formulas are the same for all.
#ifndef PP_LANES_H
#define PP_LANES_H

#include "reduce.h"
#include "vector.h"

#ifndef LANES
#define LANES 16
#endif

#if LANES == 16
#define LANED(name) name##16
#define LANE (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#define LANES_FROM(p) vload16(0, p)
#define LANES_INTO(p, value) vstore16(value, 0, p)
#define ANY_LANE(v) any(v)
#define SUM_LANES(v) sum16(v)
// load_lanes(p, count): the values at p, of which `count` exist; the others read as 0.
// store_lanes(value, p, count): writes the first `count` of the values to p.
#define load_lanes load16
#define store_lanes store16
#define GPU_UNROLLED_FOR for
#endif
#if LANES < 16
#include "gpu/lanes.h"
#endif

#define ON_CPU (LANES == 16)

// Asks for what lies at a global address before it is read, on CPUs, where walks over points wait
// mostly for what lies anywhere in memory. They look so many points ahead.
// READS_AHEAD: the driver is one that can (pp_cl/engine/device/quirks.py).
#define POINTS_AHEAD 8
#if ON_CPU && defined(READS_AHEAD)
// through a number, since its argument is a pointer to private memory
#define READ_AHEAD(address) __builtin_prefetch((const void *)(uintptr_t)(address))
#else
#define READ_AHEAD (void)
#endif

typedef LANED(float) floats;
typedef LANED(int) ints;
typedef LANED(uint) uints;

// A row of 16 channels has ROW_PARTS such vectors. Of a kernel with a work-item for each part of
// each row, ROW_PART is the item's, get_global_id(0) / ROW_PARTS its row.
#define ROW_PARTS (CHANNELS / LANES)
#define ROW_PART ((uint)get_global_id(0) % ROW_PARTS)

ALWAYS_INLINE floats load_part(global const float16 *rows, const size_t row) {
    return ((global const floats *)rows)[row * ROW_PARTS + ROW_PART];
}

ALWAYS_INLINE void store_part(const floats value, global float16 *rows, const size_t row) {
    ((global floats *)rows)[row * ROW_PARTS + ROW_PART] = value;
}

#endif
