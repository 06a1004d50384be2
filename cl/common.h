// Shared by every kernel file. Layouts and names: docs/conventions.md.
#ifndef PP_COMMON_H
#define PP_COMMON_H

#define NONE 0xffffffffu  // "no such index"

// PoCL calls functions it finds large, passing structs and vectors in memory; a simulator may
// define this as inline.
#ifndef ALWAYS_INLINE
#define ALWAYS_INLINE __attribute__((always_inline)) inline
#endif

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

// The upper half of a 16-vector lane by lane, for (float8)(...): Oclgrind 21.10 takes lane 11 of a
// shuffle for undefined.
#define UPPER_HALF(v) (v).s8, (v).s9, (v).sa, (v).sb, (v).sc, (v).sd, (v).se, (v).sf

// Sum of the products of two 16-vectors; the order of the sum is fixed by the tree below.
inline float dot16(const float16 a, const float16 b) {
    const float16 p = a * b;
    const float8 s8 = p.lo + (float8)(UPPER_HALF(p));
    const float4 s4 = s8.lo + s8.hi;
    const float2 s2 = s4.lo + s4.hi;
    return s2.x + s2.y;
}

#endif
