// Samples of a pixel, SIDE x SIDE of them in a grid, in LANES = SAMPLES lanes; and discs there.
#ifndef PP_SAMPLES_H
#define PP_SAMPLES_H

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

// The radius of a point's footprint, world units.
ALWAYS_INLINE float
reach_of(const Camera *cam, const float4 centre, global const float *point_shape, const uint i) {
    return fmax(point_shape[(size_t)SHAPE * i], LEAST_RADIUS * centre.w / least_focal(cam));
}

// A point's falloffs at the samples, 0 where it covers none: those of disc_covers().
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

#endif
