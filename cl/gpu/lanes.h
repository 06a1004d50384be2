// lanes.h for 4 lanes or a single one, on GPUs.
#ifndef PP_GPU_LANES_H
#define PP_GPU_LANES_H

#include "gpu/vector.h"

#define REDUCE4(name, T, JOIN)                                                                     \
    static inline T name(const T##4 v) {                                                           \
        const T##2 v2 = JOIN(v.lo, v.hi);                                                          \
        return JOIN(v2.x, v2.y);                                                                   \
    }

REDUCE4(sum4, float, SUM)

#if LANES == 4
#define LANED(name) name##4
#define LANE (uint4)(0, 1, 2, 3)
#define LANES_FROM(p) vload4(0, p)
#define LANES_INTO(p, value) vstore4(value, 0, p)
#define ANY_LANE(v) any(v)
#define SUM_LANES(v) sum4(v)
#define load_lanes load4
#define store_lanes store4
#else
#define LANED(name) name
#define LANE 0u
#define LANES_FROM(p) (*(p))
#define LANES_INTO(p, value) (*(p) = (value))
#define ANY_LANE(v) ((v) != 0)
#define SUM_LANES(v) (v)
#define load_lanes(p, count) (*(p))
#define store_lanes(value, p, count) (*(p) = (value))
#endif
#define GPU_UNROLLED_FOR UNROLLED_FOR

#endif
