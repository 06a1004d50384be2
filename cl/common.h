// Shared by every kernel file. Layouts and names: docs/conventions.md.
#ifndef PP_COMMON_H
#define PP_COMMON_H

#define NONE 0xffffffffu         // "no such index"

// 16 channels of one pixel or point
#define CHANNELS 16

// A well mixed integer (lowbias32 by Chris Wellons).
inline uint scramble(uint x) {
    x ^= x >> 16;
    x *= 0x7feb352du;
    x ^= x >> 15;
    x *= 0x846ca68bu;
    return x ^ (x >> 16);
}

// Sum of the products of two 16-vectors; the order of the sum is fixed by the tree below.
inline float dot16(const float16 a, const float16 b) {
    const float16 p = a * b;
    const float8 s8 = p.lo + p.hi;
    const float4 s4 = s8.lo + s8.hi;
    const float2 s2 = s4.lo + s4.hi;
    return s2.x + s2.y;
}

#endif
