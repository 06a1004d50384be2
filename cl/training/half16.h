// Sixteen values stored in 16 bits each, rounded up or down at random so that the expected value is
// exact: rounding to nearest would undo every decay of less than half a unit in the last place.
#ifndef PP_HALF16_H
#define PP_HALF16_H

#include "common.h"

#define LARGEST_HALF 65504.0f
#define SMALLEST_NORMAL_HALF 6.103515625e-05f  // 2^-14, the smallest with all its bits
#define HALF_STEPS 16777216.0f  // 2^24: below that the values are whole numbers of 2^-24
#define CUT_BITS 0x1fffu        // of a float's mantissa, those that a half lacks

// 16 random numbers for one; their high bits are the better ones.
static inline uint16 random16(const uint number) {
    return scramble(number) * (uint16)(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
}

// Write 16 values to p; the lowest 13 bits of `random` decide. Values beyond the
// largest half become it, NaN remains NaN.
static inline void store_half16(const float16 value, const uint16 random, global half *p) {
    const uint16 dither = random & CUT_BITS;
    const float16 size =
        fabs(value) > LARGEST_HALF ? LARGEST_HALF : fabs(value);  // a NaN is not larger
    const float16 normal = as_float16((as_uint16(size) + dither) & ~CUT_BITS);
    const float16 tiny =
        floor(size * HALF_STEPS + convert_float16(dither) / (CUT_BITS + 1.0f)) / HALF_STEPS;
    vstore_half16(copysign(size < SMALLEST_NORMAL_HALF ? tiny : normal, value), 0, p);
}

#endif
