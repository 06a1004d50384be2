// Footprints: which pixels points cover, their falloff d there (1 in the centre, 0 at the rim)
// and their depth. Each kind of point is a header with the same three functions:
//
// footprints_box()  their shape, and the pixels that they may cover: the first and last along x and
//                   y; false if none of those that are kept covers any
// footprints_rim()  what follows from place and shape for all pixels
// footprints_cover()  whether they cover a pixel (px, py) each, with d and depth
//
// Beside them a header has surface_range() for depth.cl, the distance from the eye where a ray
// meets the surface for which a point stands, and constants of blending and shading.
//
// Counting (project.cl) and filling (pairs.cl) must find the same fragments, so no compiler may
// round here in one way and there in another: FP_CONTRACT is OFF in what leads to a fragment.
#ifndef PP_FOOTPRINT_H
#define PP_FOOTPRINT_H

#include "camera.h"
#include "cloud.h"
#include "lanes.h"

// the kinds
#define DISC 0
#define SOFT 1
#define SPHERE 2
#define GAUSSIAN 3
#ifndef FOOTPRINT
#define FOOTPRINT SOFT
#endif
#ifndef SHAPE
#define SHAPE 1  // numbers in a row of point_shape: the radius; of Gaussians 4
#endif
#ifndef MOST_OFFSET
#define MOST_OFFSET 0.5f  // of points that are no Gaussians, pp_cl/engine/raster/footprint.py
#endif

// Samples of a pixel, each way: the camera's pixels are the samples, boxes and lists are of pixels.
#ifndef SIDE
#define SIDE 1
#endif
#define SAMPLES (SIDE * SIDE)

// What a pair keeps of its fragment: the point and, of a single sample, the bits of its falloff.
#if SIDE == 1
#define STORE_FRAGMENT(point, falloff, pair, pairs)                                                \
    vstore2((uint2)(point, as_uint(falloff)), pair, pairs)
#else
#define STORE_FRAGMENT(point, falloff, pair, pairs) ((pairs)[pair] = (point))
#endif

// The least of 1 - alpha, so that what lies behind an opaque fragment is known when gradients are
// computed; far below what an image shows.
#define LEAST_THROUGH 0x1p-24f

#define MARGIN 0.01f  // pixels around a box; far above the rounding of places

// Half the width of the smallest footprint, in pixels: a disc of this radius always reaches a
// pixel's centre, because the farthest point of a pixel is sqrt(1/2) away (Pulsar: 1.5 half
// pixels).
#define LEAST_RADIUS 0.75f

// 1 / a to half an ulp, by a step of Newton's: a GPU's division may be off by 2.5, which shifts all
// rays. Near its rim, a sphere's weight is a small difference of lengths times up to exp(1 /
// gamma).
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
    floats x, y, z;       // centre, camera axes
    floats t;             // its distance from the eye
    floats shape[SHAPE];  // as the kind has it
    int box[4][LANES];    // first x, first y, last x, last y; no pixel: last before first
    int columns, rows;    // of the widest and the highest box
} Footprints;

// How they cover a pixel each.
typedef struct {
    ints covers;  // lanes that cover it are not 0
    floats falloff, depth;
} Coverage;

// Fills in `columns` and `rows`.
ALWAYS_INLINE void footprints_measure(Footprints *f) {
    f->columns = f->rows = 0;
    GPU_UNROLLED_FOR (uint j = 0; j < LANES; j++) {
        f->columns = max(f->columns, f->box[2][j] - f->box[0][j] + 1);
        f->rows = max(f->rows, f->box[3][j] - f->box[1][j] + 1);
    }
}

// First and last pixel along one axis whose centres lie between two places, and `more` on each
// side, before clipping to the image: -2 to size + 1. low, high: in pixels, less half of one; not
// bounded: of the whole image.
ALWAYS_INLINE void pixels_between(
    const floats low,
    const floats high,
    const ints bounded,
    const float size,
    const int more,
    ints *first,
    ints *last) {
    const floats from = clamp(select((floats)(-2.0f), low, bounded), -2.0f, size);
    const floats to = clamp(select((floats)(size), high, bounded), -2.0f, size);
    // x + 2 >= 0, so truncation is floor
    *first = LANED(convert_int)(from + 2.0f) - 1 - more;
    *last = LANED(convert_int)(to + 2.0f) - 2 + more;
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
#pragma OPENCL FP_CONTRACT OFF
    return x * x + y * y + z * z;
}

#if FOOTPRINT == DISC
#include "raster/footprint/disc.h"
#elif FOOTPRINT == SOFT
#include "raster/footprint/soft.h"
#elif FOOTPRINT == SPHERE
#include "raster/footprint/sphere.h"
#elif FOOTPRINT == GAUSSIAN
#include "raster/footprint/gaussian.h"
#endif

// Tests pixel (column, row) of each point's box, which it covers if it covers one of the samples;
// falloff and depth are of the first.
ALWAYS_INLINE Coverage
footprints_test(const Footprints *f, const Rim *rim, const int column, const int row) {
    const ints x = LANES_FROM(f->box[0]) + column, y = LANES_FROM(f->box[1]) + row;
    const floats px = LANED(convert_float)(SIDE * x), py = LANED(convert_float)(SIDE * y);
    Coverage c = footprints_cover(f, rim, px, py);
    UNROLLED_FOR (int s = 1; s < SAMPLES; s++)
        c.covers |= footprints_cover(f, rim, px + s % SIDE, py + s / SIDE).covers;
    c.covers &= x <= LANES_FROM(f->box[2]) & y <= LANES_FROM(f->box[3]);
    return c;
}

#endif
