// Footprints: which samples points cover, their falloff d there (1 in the centre, 0 at the rim), and
// the derivatives of d. Each kind of point is a header with the same functions:
//
// footprints_box()    of LANES points: their shape, and the samples that they may cover; false if
//                     none of those that are kept covers any
// coverage_at()       which of LANES samples one point covers, with its falloff
// derivatives_add()   adds what samples contribute to the gradients of a point's place and shape
// derivatives_end()   the gradient of its offset (cloud.h), from these sums
//
// Beside them a header has surface_range() for depth.cl, the distance from the eye where a ray
// meets the surface for which a point stands, and constants of blending and shading.
#ifndef PP_FOOTPRINT_H
#define PP_FOOTPRINT_H

#include "camera.h"
#include "cloud.h"
#include "lanes.h"

// the kinds
#define DISC 0
#define SOFT 1
#define GAUSSIAN 2
#ifndef FOOTPRINT
#define FOOTPRINT SOFT
#endif
#ifndef RECORD
#define RECORD 8  // words of a point's record, 16 of a Gaussian
#endif
#ifndef MOST_OFFSET
#define MOST_OFFSET 0.5f  // of points that are no Gaussians, pp_cl/engine/raster/footprint.py
#endif

// Samples of a pixel, each way: the camera's pixels are the samples, boxes are of pixels.
#ifndef SUPERSAMPLING
#define SUPERSAMPLING 1
#endif
#define SAMPLES (SUPERSAMPLING * SUPERSAMPLING)
#define TILE_SIDE (16 / SUPERSAMPLING)  // pixels along a tile, tiles.h

// The least of 1 - alpha, so that what lies behind an opaque fragment is known when gradients are
// computed; far below what an image shows.
#define LEAST_THROUGH 0x1p-24f

#define MARGIN 0.01f  // pixels around a box; far above the rounding of places

// Half the width of the smallest footprint, in pixels: a disc of this radius always reaches a
// pixel's centre, because the farthest point of a pixel is sqrt(1/2) away (Pulsar: 1.5 half
// pixels).
#define LEAST_RADIUS 0.75f

// a b + c, rounded once in every kernel: the way back must find the samples covered that the way
// there did, and a compiler may fuse products and sums here in one way and there in another.
// Processors without the instruction fuse none.
#if defined(FP_FAST_FMAF) || defined(__FMA__)
#define FMA(a, b, c) fma((floats)(a), (floats)(b), (floats)(c))
#else
#define FMA(a, b, c) ((a) * (b) + (c))
#endif

// What is stored of a point in a view, in a record of words: c, size, opacity, first and last, and of
// a Gaussian W and centre.
typedef struct {
    float4 c;       // its centre in camera axes, and the distance from the eye
    float size;     // of a disc: the radius, with the sign - if it is the least one; of a Gaussian:
                    // the falloff in the centre
    float opacity;  // as seen from the eye
    uint2 first, last;  // pixels of the box
#if RECORD > 8
    float3 W;       // deviations at (x, y) pixels from the centre are (W0 x + W1 y, W2 y)
    float2 centre;  // pixels
#endif
} Point;

// The point of row i of records, which lie in global or local memory.
#define POINT_OF(records, i)                                                                       \
    point_of(                                                                                      \
        vload8((i) * (size_t)(RECORD / 8), records),                                               \
        vload8((i) * (size_t)(RECORD / 8) + (RECORD > 8), records))

ALWAYS_INLINE Point point_of(const uint8 words, const uint8 more) {
    Point p;
    p.c = as_float4(words.s0123);
    p.size = as_float(words.s4);
    p.opacity = as_float(words.s5);
    p.first = (uint2)(words.s6 & 0xffff, words.s6 >> 16);
    p.last = (uint2)(words.s7 & 0xffff, words.s7 >> 16);
#if RECORD > 8
    p.W = as_float3(more.s012);
    p.centre = as_float2(more.s34);
#endif
    return p;
}

// 1 / a to half an ulp, by a step of Newton's: a GPU's division may be off by 2.5, which shifts all
// rays.
static inline float reciprocal(const float a) {
    const float nearly = 1.0f / a;
    return nearly + nearly * fma(-a, nearly, 1.0f);
}

// The width of a pixel at range t is t divided by this: the smaller focal length has the wider
// pixels.
static inline float least_focal(const Camera *cam) {
    return fmin(cam->fx, cam->fy);
}

// The footprints of LANES neighbouring points, one lane each.
typedef struct {
    floats x, y, z;  // centre, camera axes
    floats t;        // its distance from the eye
    floats size;     // as a Point has it
#if RECORD > 8
    floats W[3], centre[2];
#endif
    ints first[2], last[2];  // samples that they may cover, before clipping to the image
} Footprints;

// First and last pixel along one axis whose centres lie between two places, before clipping to the
// image: -2 to size + 1. low, high: in pixels, less half of one; not bounded: of the whole image.
ALWAYS_INLINE void pixels_between(
    const floats low,
    const floats high,
    const ints bounded,
    const float size,
    ints *first,
    ints *last) {
    const floats from = clamp(select((floats)(-2.0f), low, bounded), -2.0f, size);
    const floats to = clamp(select((floats)(size), high, bounded), -2.0f, size);
    // x + 2 >= 0, so truncation is floor
    *first = LANED(convert_int)(from + 2.0f) - 1;
    *last = LANED(convert_int)(to + 2.0f) - 2;
}

// Whether circles around (u, z), u = x or y, come so near to the image along that axis that they
// may cover a pixel. Their distance from the plane through the eye and one of its sides, of slope
// m, is (u - m z) / sqrt(1 + m^2).
ALWAYS_INLINE ints reaches_image(
    const floats u,
    const floats z,
    const floats reach,
    const float focal,
    const float centre,
    const float size) {
    const float low = -centre / focal, high = (size - centre) / focal;
    const floats wide = 1.25f * reach;  // far above rounding
    return (u - low * z >= -(1.0f + fabs(low)) * wide) &
           (high * z - u >= -(1.0f + fabs(high)) * wide);
}

// The squared length. A function of vectors: else PoCL splits them in those that it is called from.
ALWAYS_INLINE floats square(const floats x, const floats y, const floats z) {
    return x * x + y * y + z * z;
}

// 1 / sqrt(x) and 1 / x. CPUs have instructions for at least 11 bits, which a step of Newton's
// doubles.
ALWAYS_INLINE floats per_root(const floats x) {
#if ON_CPU
    const floats nearly = native_rsqrt(x);
    return nearly * (1.5f - 0.5f * x * nearly * nearly);
#else
    return rsqrt(x);
#endif
}

ALWAYS_INLINE floats inverse(const floats x) {
#if ON_CPU
    const floats nearly = native_recip(x);
    return nearly * (2.0f - x * nearly);
#else
    return 1.0f / x;
#endif
}

// The rays (x, y, 1) through the samples of a block of a tile, in camera axes, and the samples.
typedef struct {
    floats x, y, length2, per_length;
#if FOOTPRINT == GAUSSIAN
    floats column, row;  // their centres, pixels
#endif
} Rays;

#if FOOTPRINT == DISC
#include "raster/footprint/disc.h"
#elif FOOTPRINT == SOFT
#include "raster/footprint/soft.h"
#elif FOOTPRINT == GAUSSIAN
#include "raster/footprint/gaussian.h"
#endif

#endif
