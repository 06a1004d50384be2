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

// 16 values from p. Written out, since PoCL's vload_half16 converts them one by one: all lanes at
// once take half the time of an update.
static inline float16 load_half16(global const half *p) {
    const uint16 bits = convert_uint16(vload16(0, (global const ushort *)p)), size = bits & 0x7fff;
    const float16 normal = as_float16((size << 13) + 0x38000000u);
    const float16 tiny = convert_float16(size) / HALF_STEPS;
    const float16 huge = as_float16((size << 13) | 0x7f800000u);  // Inf and NaN
    const float16 value = size < 0x400u ? tiny : size < 0x7c00u ? normal : huge;
    return as_float16(as_uint16(value) | (bits & 0x8000u) << 16);
}

// Write 16 values to p; the lowest 13 bits of `random` decide. Values beyond the
// largest half become it, NaN remains NaN.
static inline void store_half16(const float16 value, const uint16 random, global half *p) {
    const uint16 dither = random & CUT_BITS;
    const float16 size =
        fabs(value) > LARGEST_HALF ? LARGEST_HALF : fabs(value);  // a NaN is not larger
    const uint16 normal = (as_uint16(size) + dither - 0x38000000u) >> 13;
    // a NaN is not smaller
    const float16 steps = select(size, (float16)(0.0f), size >= SMALLEST_NORMAL_HALF) * HALF_STEPS;
    const uint16 tiny = convert_uint16(steps + convert_float16(dither) / (CUT_BITS + 1.0f));
    const uint16 half_size = size < SMALLEST_NORMAL_HALF ? tiny : size == size ? normal : 0x7e00u;
    const uint16 sign = as_uint16(value) >> 16 & 0x8000u;
    vstore16(convert_ushort16(half_size | sign), 0, (global ushort *)p);
}

#endif
