// Macros that every kernel file needs. Layouts and names: docs/conventions.md.
#ifndef PP_COMMON_H
#define PP_COMMON_H

// The vectors are written out. Intel's compiler would merge work-items into wider ones, which makes
// kernels up to eight times slower, and some take 30 times as long to build.
#define kernel __kernel __attribute__((vec_type_hint(float16)))

#define NONE 0xffffffffu  // "no such index"

// Every helper is static: a plain `inline` one has no definition to link with where a compiler
// declines to inline it. PoCL calls functions that it finds large, with structs and vectors passed
// in memory, unless forced to inline them; a simulator that cannot defines ALWAYS_INLINE as static.
#ifndef ALWAYS_INLINE
#define ALWAYS_INLINE __attribute__((always_inline)) static inline
#endif

// Before a loop over an array of a work-item, which is in registers only where indices are known.
#define UNROLLED_FOR _Pragma("unroll") for

// A value in [least, most]; clamp() would hide a NaN.
#define BOUNDED(value, least, most)                                                                \
    ((value) < (least) ? (least) : (value) > (most) ? (most) : (value))

// A gradient of which an optimiser takes the square: with an infinite one, the second moment would
// be infinite for good, or NaN.
#define BOUNDED_GRADIENT(type, g) BOUNDED(g, (type)(-1e18f), (type)(1e18f))

// 16 channels of one pixel or point
#define CHANNELS 16

#define BACKGROUND 1.0f  // every feature of a pixel without fragments

// The depth of a key, the weight beside a point.
ALWAYS_INLINE float upper_float(const ulong word) {
    return as_float((uint)(word >> 32));
}

// The upper half of a 16-vector lane by lane, for (float8)(...): Oclgrind 21.10 takes lane 11 of a
// shuffle for undefined.
#define UPPER_HALF(v) (v).s8, (v).s9, (v).sa, (v).sb, (v).sc, (v).sd, (v).se, (v).sf

#endif
