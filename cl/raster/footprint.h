// Which pixels a point covers, how centrally, and at what depth: the one place that knows the three
// kinds of footprint.
#ifndef PP_FOOTPRINT_H
#define PP_FOOTPRINT_H

#include "camera.h"
#include "lanes.h"

#define DISC 0    // hard disc of the paper: d = 1 everywhere
#define SOFT 1    // d falls linearly from the centre to the rim (ours)
#define SPHERE 2  // Pulsar's sphere: depth of its front, sub-pixel rule, any radius

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

// Those of LANES neighbouring points, one lane each.
typedef struct {
    floats x, y, z;     // centre, camera axes
    floats t;           // its distance from the eye
    floats radius;      // world units
    floats least;       // LEAST_RADIUS pixels at range t, world units
    ints tiny;          // the radius is below one pixel
    int box[4][LANES];  // first x, first y, last x, last y; no pixel: last before first
    int columns, rows;  // of the widest and the highest box
    // reciprocals, since dividing 16 lanes by one number is slower than multiplying them
    floats per_reach;
    float per_fx, per_fy;
} Footprints;

// Reads those of the points from `first` on, of which `count` exist; the others have empty boxes.
ALWAYS_INLINE Footprints footprints_load(
    const Camera *cam,
    const uint first,
    const uint count,
    const uint radii,
    global const float *point_radius,
    global const float4 *point_camera,
    global const ushort4 *point_box) {
    Footprints f;
    float place[4][LANES], radius[LANES];
    f.columns = f.rows = 0;
    for (uint j = 0; j < LANES; j++) {
        const uint i = first + min(j, count - 1);
        const float4 at = point_camera[i];
        const int4 box = j < count ? convert_int4(point_box[i]) : (int4)(1, 1, 0, 0);
        place[0][j] = at.x;
        place[1][j] = at.y;
        place[2][j] = at.z;
        place[3][j] = at.w;
        radius[j] = point_radius[radii == 1 ? 0 : i];
        f.box[0][j] = box.x;
        f.box[1][j] = box.y;
        f.box[2][j] = box.z;
        f.box[3][j] = box.w;
        f.columns = max(f.columns, box.z - box.x + 1);
        f.rows = max(f.rows, box.w - box.y + 1);
    }
    f.x = LANES_FROM(place[0]);
    f.y = LANES_FROM(place[1]);
    f.z = LANES_FROM(place[2]);
    f.t = LANES_FROM(place[3]);
    f.radius = LANES_FROM(radius);
    const floats width = f.t / least_focal(cam);
    f.least = LEAST_RADIUS * width;
    f.tiny = f.radius < width;
    f.per_reach = 1.0f / fmax(f.radius, f.least);
    f.per_fx = 1.0f / cam->fx;
    f.per_fy = 1.0f / cam->fy;
    return f;
}

// Tests pixel (column, row) of each point's box: lanes that hit are not 0.
ALWAYS_INLINE ints footprints_hit(
    const Camera *cam,
    const Footprints *f,
    const int column,
    const int row,
    floats *closeness,
    floats *depth) {
// Counting and filling must find the same hits, so no compiler may round here in one way and
// there in another.
#pragma OPENCL FP_CONTRACT OFF
    const ints x = LANES_FROM(f->box[0]) + column, y = LANES_FROM(f->box[1]) + row;
    const floats px = LANED(convert_float)(x), py = LANED(convert_float)(y);
    const floats mx = (px + (0.5f - cam->cx)) * f->per_fx;
    const floats my = (py + (0.5f - cam->cy)) * f->per_fy;
    // the unit ray is (mx, my, 1) * inverse
    const floats inverse = 1.0f / sqrt(mx * mx + my * my + 1.0f);
    const floats range = f->t * inverse;
    const floats ex = f->x - range * mx, ey = f->y - range * my, ez = f->z - range;
    // |c - t r|^2; the expanded square would cancel
    const floats rho2 = ex * ex + ey * ey + ez * ez;
    ints hit = x <= LANES_FROM(f->box[2]) && y <= LANES_FROM(f->box[3]);
#if FOOTPRINT != SPHERE
    // differs from Pulsar: its depth is the front's, up to R nearer, and from a radius of a pixel
    // on no d is constant.
    const floats reach = fmax(f->radius, f->least);
    hit = hit && rho2 < reach * reach;
    *closeness = FOOTPRINT == DISC ? (floats)(1.0f) : 1.0f - sqrt(rho2) * f->per_reach;
    *depth = f->t;
#else
    const floats rho = sqrt(rho2);
    const ints through = rho < f->least;
    hit = hit && (rho <= f->radius || through);
    *closeness = clamp(1.0f - rho / f->radius, 0.0f, 1.0f);
    *closeness = select(*closeness, (floats)(1.0f), f->tiny && through);
    const floats along = fmin((f->x * mx + f->y * my + f->z) * inverse, f->t);
    const floats wx = f->x - along * inverse * mx, wy = f->y - along * inverse * my;
    const floats wz = f->z - along * inverse;
    // distance of the centre from the ray
    const floats w = sqrt(wx * wx + wy * wy + wz * wz);
    *depth = fmax(along - sqrt((f->radius + w) * fmax(f->radius - w, 0.0f)), 0.0f);
#endif
    return hit;
}

#endif
