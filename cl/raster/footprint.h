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

// Pixels are tested in blocks of 4 x 4, 2 x 2 or one, one lane each.
#if LANES == 16
#define BLOCK_SIDE 4
#define LANE_X (float16)(0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3)
#define LANE_Y (float16)(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3)
#define LANE_BIT                                                                                   \
    (int16)(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768)
#define LANE_BITS(hit) (uint) or_int16((hit) & LANE_BIT)
#elif LANES == 4
#define BLOCK_SIDE 2
#define LANE_X (float4)(0, 1, 0, 1)
#define LANE_Y (float4)(0, 0, 1, 1)
#define LANE_BITS(hit) (uint) or_int4((hit) & (int4)(1, 2, 4, 8))
#else
#define BLOCK_SIDE 1
#define LANE_X 0.0f
#define LANE_Y 0.0f
#define LANE_BITS(hit) (uint)(hit)
#endif
// Half the width of the smallest footprint, in pixels: a disc of this radius always reaches a
// pixel's centre, because the farthest point of a pixel is sqrt(1/2) away (Pulsar: 1.5 half
// pixels).
#define LEAST_RADIUS 0.75f

typedef struct {
    float3 centre;  // camera axes
    float t;        // its distance from the eye
    float radius;   // world units
    float least;    // LEAST_RADIUS pixels at range t, world units
    int tiny;       // the radius is below one pixel
    // reciprocals, since dividing 16 lanes by one number is slower than multiplying them
    float per_fx, per_fy, per_reach;
} Footprint;

// Width of a pixel at range t; the smaller focal length has the wider pixels.
static inline float pixel_width(const Camera *cam, const float t) {
    return t / fmin(cam->fx, cam->fy);
}

ALWAYS_INLINE Footprint footprint_load(const Camera *cam, const float4 point, const float radius) {
    Footprint f;
    const float width = pixel_width(cam, point.w);
    f.centre = point.xyz;
    f.t = point.w;
    f.radius = radius;
    f.least = LEAST_RADIUS * width;
    f.tiny = f.radius < width;
    f.per_fx = 1.0f / cam->fx;
    f.per_fy = 1.0f / cam->fy;
    f.per_reach = 1.0f / fmax(f.radius, f.least);
    return f;
}

// Tests the block of pixels from (x, y) on, as far as it lies in the box: bit BLOCK_SIDE j + i of
// the result is pixel (x + i, y + j).
ALWAYS_INLINE uint footprint_block(
    const Camera *cam,
    const Footprint *f,
    const int4 box,
    const int x,
    const int y,
    floats *closeness,
    floats *depth) {
// Counting and filling must find the same hits, so no compiler may round here in one way and
// there in another.
#pragma OPENCL FP_CONTRACT OFF
    const floats px = LANE_X + (float)x, py = LANE_Y + (float)y;
    const floats mx = (px + (0.5f - cam->cx)) * f->per_fx;
    const floats my = (py + (0.5f - cam->cy)) * f->per_fy;
    // the unit ray is (mx, my, 1) * inverse
    const floats inverse = 1.0f / sqrt(mx * mx + my * my + 1.0f);
    const floats range = f->t * inverse;
    const floats ex = f->centre.x - range * mx, ey = f->centre.y - range * my,
                 ez = f->centre.z - range;
    // |c - t r|^2; the expanded square would cancel
    const floats rho2 = ex * ex + ey * ey + ez * ez;
    ints hit = px <= (float)box.z && py <= (float)box.w;
#if FOOTPRINT != SPHERE
    // differs from Pulsar: its depth is the front's, up to R nearer, and from a radius of a pixel
    // on no d is constant.
    const float reach = fmax(f->radius, f->least);
    hit = hit && rho2 < reach * reach;
    *closeness = FOOTPRINT == DISC ? (floats)(1.0f) : 1.0f - sqrt(rho2) * f->per_reach;
    *depth = f->t;
#else
    const floats rho = sqrt(rho2);
    const ints through = rho < f->least;
    hit = hit && (rho <= f->radius || through);
    *closeness = clamp(1.0f - rho / f->radius, 0.0f, 1.0f);
    if (f->tiny) *closeness = select(*closeness, (floats)(1.0f), through);
    const floats along = fmin((f->centre.x * mx + f->centre.y * my + f->centre.z) * inverse, f->t);
    const floats wx = f->centre.x - along * inverse * mx, wy = f->centre.y - along * inverse * my;
    const floats wz = f->centre.z - along * inverse;
    // distance of the centre from the ray
    const floats w = sqrt(wx * wx + wy * wy + wz * wz);
    *depth = fmax(along - sqrt((f->radius + w) * fmax(f->radius - w, 0.0f)), 0.0f);
#endif
    return LANE_BITS(hit);
}

#endif
