// Footprints: which pixels a point covers, its closeness d there (1 in the centre, 0 at the rim)
// and its depth. The one place that knows the four kinds.
#ifndef PP_FOOTPRINT_H
#define PP_FOOTPRINT_H

#include "camera.h"
#include "lanes.h"

#define DISC 0    // hard disc of the paper: d = 1 everywhere
#define SOFT 1    // d falls linearly from the centre to the rim (ours)
#define SPHERE 2  // Pulsar's sphere: depth of its front, sub-pixel rule, any radius
// The Gaussian of 3D Gaussian splatting, as its viewers draw it: d = exp(-|s|^2 / 2) with s the
// distance from the centre in deviations, on the screen, where its covariance is J C J^T + LOW_PASS I:
// C in space, J the derivative of the projection in the centre. Its depth is along the camera's axis.
// Of a pixel that is the mean of several of a viewer's, see widened().
#define GAUSSIAN 3
#define LOW_PASS 0.3f                // of a viewer's pixels^2
#define LEAST_ALPHA (1.0f / 255.0f)  // of a hit: below it viewers draw nothing
#define MOST_ALPHA 0.99f
#define DEVIATIONS 3.33f  // to the rim, where an opaque one falls below LEAST_ALPHA

#ifndef FOOTPRINT
#define FOOTPRINT SOFT
#endif

// Half the width of the smallest footprint, in pixels: a disc of this radius always reaches a
// pixel's centre, because the farthest point of a pixel is sqrt(1/2) away (Pulsar: 1.5 half
// pixels).
#define LEAST_RADIUS 0.75f

// The width of a pixel at range t is t divided by this: the smaller focal length has the wider
// pixels.
static inline float least_focal(const Camera *cam) {
    return fmin(cam->fx, cam->fy);
}

// 1 / a to half an ulp, by a step of Newton's: a GPU's division may be off by 2.5, which shifts all
// rays. Near its rim, a sphere's weight is a small difference of lengths times up to exp(1 / gamma).
static inline float reciprocal(const float a) {
    const float nearly = 1.0f / a;
    return nearly + nearly * fma(-a, nearly, 1.0f);
}

// What viewers add to the variances of a Gaussian, in pixels^2, and what a mean of viewers' pixels
// has besides: the variance of `samples` places in a row, 1 pixel in all. The mean over a pixel is
// nearly a Gaussian as wide that keeps the integral, with a lower peak.
static inline float low_pass(const Camera *cam) {
    return LOW_PASS / (cam->samples * cam->samples);
}

static inline float widened(const Camera *cam) {
    return low_pass(cam) + (1.0f - 1.0f / (cam->samples * cam->samples)) / 12.0f;
}

// The footprints of LANES neighbouring points, one lane each.
typedef struct {
    floats x, y, z;     // centre, camera axes
    floats t;           // its distance from the eye
    floats radius;      // world units
    int box[4][LANES];  // first x, first y, last x, last y; no pixel: last before first
    // what follows from these
    int columns, rows;  // of the widest and the highest box
    floats least;       // LEAST_RADIUS pixels at range t, world units
    floats reach;       // from the ray to the rim, world units
    ints tiny;          // the radius is below one pixel
    // reciprocals, since dividing 16 lanes by one number is slower than multiplying them
    floats per_reach;
    float per_fx, per_fy;
#if FOOTPRINT == GAUSSIAN
    floats u, v;  // centre, pixels
    // deviations at (x, y) pixels from it, (white[0] x + white[1] y, white[2] y), and its closeness
    // in the centre
    floats white[4];
#endif
} Footprints;

// Fills in the fields that follow from the others.
ALWAYS_INLINE void footprints_prepare(const Camera *cam, Footprints *f) {
#pragma OPENCL FP_CONTRACT OFF
    f->columns = f->rows = 0;
    UNROLLED for (uint j = 0; j < LANES; j++) {
        f->columns = max(f->columns, f->box[2][j] - f->box[0][j] + 1);
        f->rows = max(f->rows, f->box[3][j] - f->box[1][j] + 1);
    }
    const floats width = f->t / least_focal(cam);
    f->least = LEAST_RADIUS * width;
    f->tiny = f->radius < width;
    f->reach = fmax(f->radius, f->least);
    f->per_reach = 1.0f / f->reach;
    f->per_fx = reciprocal(cam->fx);
    f->per_fy = reciprocal(cam->fy);
#if FOOTPRINT == GAUSSIAN
    f->u = f->x / f->z * cam->fx + cam->cx;
    f->v = f->y / f->z * cam->fy + cam->cy;
#endif
}

// The squared length. A function of vectors: else PoCL splits them in those that it is called from.
ALWAYS_INLINE floats square(const floats x, const floats y, const floats z) {
#pragma OPENCL FP_CONTRACT OFF
    return x * x + y * y + z * z;
}

// Tests pixel (column, row) of each point's box: lanes that hit are not 0.
ALWAYS_INLINE ints footprints_hit(
    const Camera *cam,
    const Footprints *f,
    const int column,
    const int row,
    floats *closeness,
    floats *depth) {
// Counting (project.cl) and filling (pairs.cl) must find the same hits, so no compiler may round
// here in one way and there in another.
#pragma OPENCL FP_CONTRACT OFF
    const ints x = LANES_FROM(f->box[0]) + column, y = LANES_FROM(f->box[1]) + row;
    const floats px = LANED(convert_float)(x), py = LANED(convert_float)(y);
    ints hit = x <= LANES_FROM(f->box[2]) && y <= LANES_FROM(f->box[3]);
#if FOOTPRINT == GAUSSIAN
    const floats dx = px + 0.5f - f->u, dy = py + 0.5f - f->v;
    const floats sx = f->white[0] * dx + f->white[1] * dy, sy = f->white[2] * dy;
    const floats s2 = sx * sx + sy * sy;
    hit = hit && s2 < DEVIATIONS * DEVIATIONS;
    *closeness = f->white[3] * exp(-0.5f * s2);
    *depth = f->z;
#else
    const floats mx = (px + (0.5f - cam->cx)) * f->per_fx;
    const floats my = (py + (0.5f - cam->cy)) * f->per_fy;
    const floats m2 = mx * mx + my * my + 1.0f;  // of (mx, my, 1), along the ray
#if FOOTPRINT != SPHERE
    // Differs from Pulsar, whose distance from the ray is that at the centre's range, whose depth is
    // that of the sphere's front, up to a radius nearer, and whose d varies within every footprint of
    // at least a pixel.
    const floats ex = f->y - f->z * my, ey = f->z * mx - f->x, ez = f->x * my - f->y * mx;
    const floats across2 = square(ex, ey, ez);  // the distance, squared, times m2
    hit = hit && across2 < f->reach * f->reach * m2 && f->x * mx + f->y * my + f->z > 0.0f;
    *closeness = FOOTPRINT == DISC ? (floats)(1.0f) : 1.0f - sqrt(across2 / m2) * f->per_reach;
    *depth = f->t;
#else
    const floats nearly = 1.0f / sqrt(m2);  // as in reciprocal()
    const floats inverse = nearly + 0.5f * nearly * fma(-m2 * nearly, nearly, (floats)(1.0f));
    const floats range = f->t * inverse;
    const floats dx = f->x - range * mx, dy = f->y - range * my, dz = f->z - range;
    const floats rho = sqrt(square(dx, dy, dz));  // the expanded square would cancel
    const ints through = rho < f->least;
    hit = hit && (rho <= f->radius || through);
    *closeness = clamp(1.0f - rho / f->radius, 0.0f, 1.0f);
    *closeness = select(*closeness, (floats)(1.0f), f->tiny && through);
    const floats along = fmin((f->x * mx + f->y * my + f->z) * inverse, f->t);
    const floats wx = f->x - along * inverse * mx, wy = f->y - along * inverse * my;
    const floats wz = f->z - along * inverse;
    // distance of the centre from the ray
    const floats w = sqrt(square(wx, wy, wz));
    *depth = fmax(along - sqrt((f->radius + w) * fmax(f->radius - w, 0.0f)), 0.0f);
#endif
#endif
    return hit;
}

#endif
