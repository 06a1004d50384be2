// The shape of the demo's object as a signed distance field: an armillary sphere, that is a globe
// on an axle between a brass band, a ring and a wheel with thin spokes, on a base. Everything is
// computed for LANES places at a time.
#ifndef PP_DEMO_OBJECT_H
#define PP_DEMO_OBJECT_H

#include "lanes.h"

// A ball that holds the object.
#define BOUND_Z -0.08f
#define BOUND_RADIUS 1.05f

// The globe's centre is the origin of all parts. Its axle, WHEEL, lies in the planes of the other
// two rings, whose unit normals are MERIDIAN and ECLIPTIC; MERIDIAN, WHEEL_V and WHEEL are at right
// angles.
#define GLOBE_Z 0.15f
#define GLOBE_RADIUS 0.30f
#define WHEEL ((float3)(-0.242404f, 0.346188f, 0.906308f))
#define WHEEL_V ((float3)(-0.519837f, 0.742404f, -0.422618f))
#define MERIDIAN ((float3)(0.819152f, 0.573576f, 0.0f))
#define ECLIPTIC ((float3)(-0.040616f, 0.929729f, -0.365998f))

// Indices of the parts' distances.
#define BASE 0
#define BRASS 1
#define BAND 2
#define SPOKES 3
#define GLOBE 4
#define PARTS 5

typedef struct {
    floats x, y, z;
} Vectors;

static inline floats dot_axis(const Vectors a, const float3 n) {
    return a.x * n.x + a.y * n.y + a.z * n.z;
}

static inline floats dot_lanes(const Vectors a, const Vectors b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline Vectors advance(const Vectors from, const Vectors direction, const floats t) {
    return (Vectors){from.x + t * direction.x, from.y + t * direction.y, from.z + t * direction.z};
}

static inline Vectors normalize_lanes(const Vectors a) {
    const floats scale = 1.0f / sqrt(dot_lanes(a, a));
    return (Vectors){a.x * scale, a.y * scale, a.z * scale};
}

static inline floats length_lanes(const floats a, const floats b) {
    return sqrt(a * a + b * b);
}

// Distance of a rounded rectangle of half sides ha + r and hb + r from (a, b), measured from its
// centre.
static inline floats
rectangle(const floats a, const floats b, const float ha, const float hb, const float r) {
    const floats u = fabs(a) - ha, v = fabs(b) - hb;
    return length_lanes(max(u, 0.0f), max(v, 0.0f)) + min(max(u, v), 0.0f) - r;
}

// Distance of a rod with round ends: `along` and `off` are the coordinates along its axis and from
// it.
static inline floats
rod(const floats along, const floats off, const float from, const float to, const float radius) {
    return length_lanes(along - clamp(along, from, to), off) - radius;
}

// Distances of a place to all parts, each exact outside of its part.
static inline void parts(const Vectors position, floats *distances) {
    const Vectors p = {position.x, position.y, position.z - GLOBE_Z};
    const floats square = dot_lanes(p, p), from_axis = length_lanes(p.x, p.y);
    // Every ring has a height over its plane and a radius in it.
    const floats wheel_h = dot_axis(p, WHEEL),
                 wheel_r = sqrt(max(square - wheel_h * wheel_h, 0.0f));
    const floats ecliptic_h = dot_axis(p, ECLIPTIC),
                 ecliptic_r = sqrt(max(square - ecliptic_h * ecliptic_h, 0.0f));
    const floats meridian_h = dot_axis(p, MERIDIAN),
                 meridian_r = sqrt(max(square - meridian_h * meridian_h, 0.0f));

    distances[GLOBE] = sqrt(square) - GLOBE_RADIUS;
    distances[BASE] = rectangle(from_axis, p.z + 1.03f, 0.50f, 0.05f, 0.03f);
    distances[BAND] = rectangle(meridian_r - 0.70f, meridian_h, 0.018f, 0.05f, 0.006f);

    const floats knob = length_lanes(from_axis, p.z + 0.88f) - 0.07f;
    const floats stem = rod(p.z, from_axis, -1.0f, -0.72f, 0.03f);
    const floats axle = rod(wheel_h, wheel_r, -0.69f, 0.69f, 0.014f);
    const floats wheel = length_lanes(wheel_r - 0.54f, wheel_h) - 0.024f;
    const floats ecliptic = length_lanes(ecliptic_r - 0.62f, ecliptic_h) - 0.018f;
    distances[BRASS] = min(min(min(knob, stem), min(axle, wheel)), ecliptic);

    // 12 spokes: the wheel's plane is folded to the 15 degrees beside the first one.
    const floats a = fabs(meridian_h), b = fabs(dot_axis(p, WHEEL_V)), u = max(a, b), v = min(a, b);
    // beyond the bisector to the next spoke, twice
    const floats over = 2.0f * max(0.965926f * v - 0.258819f * u, 0.0f);
    distances[SPOKES] =
        rod(u + 0.258819f * over, length_lanes(v - 0.965926f * over, wheel_h), 0.2f, 0.54f, 0.011f);
}

// Distance of a place to the object; negative inside.
static inline floats scene_distance(const Vectors p) {
    floats d[PARTS];
    parts(p, d);
    return min(min(min(d[BASE], d[BRASS]), min(d[BAND], d[SPOKES])), d[GLOBE]);
}

#endif
