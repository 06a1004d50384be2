// The 16 lanes of a vector reduced to one value: always lane i with lane i + 8, then i + 4, i + 2 and
// i + 1, so that the order of a sum is fixed.
#ifndef PP_REDUCE_H
#define PP_REDUCE_H

#include "common.h"

#define REDUCE16(name, T, JOIN)                                                                    \
    static inline T name(const T##16 v) {                                                          \
        const T##8 v8 = JOIN(v.lo, (T##8)(UPPER_HALF(v)));                                         \
        const T##4 v4 = JOIN(v8.lo, v8.hi);                                                        \
        const T##2 v2 = JOIN(v4.lo, v4.hi);                                                        \
        return JOIN(v2.x, v2.y);                                                                   \
    }
#define SUM(a, b) ((a) + (b))

REDUCE16(sum16, float, SUM)
REDUCE16(max16, float, fmax)

// Sum of the products of two 16-vectors.
static inline float dot16(const float16 a, const float16 b) {
    return sum16(a * b);
}

#endif
