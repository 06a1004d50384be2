// Samples of a pixel, SIDE x SIDE of them in a grid, in LANES = SAMPLES lanes, and fragments there.
#ifndef PP_SAMPLES_H
#define PP_SAMPLES_H

#ifndef LANES
#define LANES 1  // SAMPLES
#endif

#include "common.h"
#include "lanes.h"
#include "raster/footprint.h"

// The rays (x, y, 1) through the samples of a pixel, in camera axes.
typedef struct {
    floats x, y;
    floats length2, per_length;
} Rays;

ALWAYS_INLINE Rays rays_of(const Camera *cam, const uint q) {
#pragma OPENCL FP_CONTRACT OFF
    const uint width = cam->width / SIDE;
    const floats px = LANED(convert_float)(SIDE * (q % width) + LANE % SIDE);
    const floats py = LANED(convert_float)(SIDE * (q / width) + LANE / SIDE);
    Rays m;
    m.x = (px + (0.5f - cam->cx)) * reciprocal(cam->fx);
    m.y = (py + (0.5f - cam->cy)) * reciprocal(cam->fy);
    m.length2 = m.x * m.x + m.y * m.y + 1.0f;
    m.per_length = 1.0f / sqrt(m.length2);
    return m;
}

// The radius of a disc's footprint. c: its centre, and its distance from the eye.
ALWAYS_INLINE float reach_of(const Camera *cam, const float4 c, const float radius) {
    return fmax(radius, LEAST_RADIUS * c.w / least_focal(cam));
}

// A disc's falloffs at the samples, 0 where it covers none: those of disc_covers().
ALWAYS_INLINE floats falloffs(const Rays *m, const float4 c, const float reach) {
#pragma OPENCL FP_CONTRACT OFF
    const floats ex = c.y - c.z * m->y, ey = c.z * m->x - c.x, ez = c.x * m->y - c.y * m->x;
    const floats across2 = square(ex, ey, ez);
    const ints covers = across2 < reach * reach * m->length2 & c.x * m->x + c.y * m->y + c.z > 0.0f;
#if FOOTPRINT == SOFT
    const floats d = 1.0f - sqrt(across2) * (m->per_length * (1.0f / reach));
#else
    const floats d = 1.0f;
#endif
    return select((floats)(0.0f), d, covers);
}

typedef struct {
    uint point;
    floats falloff;
} Fragment;

// A pair's fragment, in the pixel with these rays. One sample's falloff is stored with the point,
// those of several are computed again.
ALWAYS_INLINE Fragment fragment_load(
    const uint pair,
    const Camera *cam,
    const Rays *m,
    global const float4 *point_camera,
    global const float *point_shape,
    global const uint *pair_point_falloff) {
#if SAMPLES == 1
    const uint2 stored = vload2(pair, pair_point_falloff);
    return (Fragment){stored.x, as_float(stored.y)};
#else
    const uint point = pair_point_falloff[pair];
    const float4 c = point_camera[point];
    return (Fragment){point, falloffs(m, c, reach_of(cam, c, point_shape[(size_t)SHAPE * point]))};
#endif
}

// The transmittance behind fragments of which samples see this alpha, with T in front. fmax() would
// hide a NaN.
ALWAYS_INLINE floats transmit(const floats T, const floats alpha) {
    const floats through = 1.0f - alpha;
    return T * select(through, (floats)(LEAST_THROUGH), through < LEAST_THROUGH);
}

#endif
