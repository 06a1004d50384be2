// Values stored in 16 bits each, rounded up or down at random so that the expected value is
// exact: rounding to nearest would undo every decay of less than half a unit in the last place.
#ifndef PP_HALF16_H
#define PP_HALF16_H

#include "common.h"
#include "lanes.h"

#define LARGEST_HALF 65504.0f
#define SMALLEST_NORMAL_HALF 6.103515625e-05f  // 2^-14, the smallest with all its bits
#define HALF_STEPS 16777216.0f  // 2^24: below that the values are whole numbers of 2^-24
#define CUT_BITS 0x1fffu        // of a float's mantissa, those that a half lacks

// Of 16 random numbers for one, those of a work-item's part; their high bits are the better ones.
ALWAYS_INLINE uints random_part(const uint number) {
    return scramble(number) * (2 * (ROW_PART * LANES + LANE) + 1);
}

// Write a work-item's part of a row; the lowest 13 bits of `random` decide. Values beyond the
// largest half become it, NaN remains NaN.
ALWAYS_INLINE void
store_half_part(const floats value, const uints random, global half *rows, const size_t row) {
    const uints dither = random & CUT_BITS;
    const floats size =
        fabs(value) > LARGEST_HALF ? LARGEST_HALF : fabs(value);  // a NaN is not larger
    const floats normal = LANED(as_float)((LANED(as_uint)(size) + dither) & ~CUT_BITS);
    const floats tiny =
        floor(size * HALF_STEPS + LANED(convert_float)(dither) / (CUT_BITS + 1.0f)) / HALF_STEPS;
    const floats rounded = copysign(size < SMALLEST_NORMAL_HALF ? tiny : normal, value);
    LANED(vstore_half)(rounded, row * ROW_PARTS + ROW_PART, rows);
}

#endif
