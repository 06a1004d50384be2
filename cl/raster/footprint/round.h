// What discs, soft discs and spheres share: points with a radius, in world units.
#ifndef PP_ROUND_H
#define PP_ROUND_H

#ifndef PULSAR
#define PULSAR 0  // 1: the box is Pulsar's
#endif
#define FORM 1  // numbers of what points learn of their form, of which LOGS are logarithms
#define LOGS 1
#define LARGEST(radius) ((radius) * exp(MOST_OFFSET))  // of points that have one without offsets
#define CLAMPED 0                                      // features may be below 0
#define LEAST_ALPHA -INFINITY                          // alphas are what they are
#define MOST_ALPHA INFINITY

// First and last pixel along one axis that circles around (u, z), u = x or y, may cover.
//
// The tangents from the eye to a circle of radius r have slopes m with (m z - u)^2 = r^2 (1 + m^2);
// a circle that reaches the eye's plane has no bounds.
ALWAYS_INLINE void tangents(
    const floats u,
    const floats z,
    const floats reach,
    const float focal,
    const float centre,
    const float size,
    ints *first,
    ints *last) {
    const float margin = PULSAR ? 0.0f : MARGIN;
    const floats scale = z * z - reach * reach, root = reach * sqrt(u * u + scale);
    const floats low = (u * z - root) / scale * focal + (centre - 0.5f - margin);
    const floats high = (u * z + root) / scale * focal + (centre - 0.5f + margin);
    // from floor(first) to ceil(last): Pulsar's box is part of its rule of coverage
    pixels_between(low, high, z > reach, size, PULSAR, first, last);
}

ALWAYS_INLINE bool footprints_box(
    const Camera *cam,
    const floats form[FORM],
    const ints kept,
    Footprints *f,
    ints first[2],
    ints last[2]) {
    f->shape[0] = form[0];
    const floats wide = fmax(form[0], LEAST_RADIUS * f->t / least_focal(cam));
    const floats reach = PULSAR ? form[0] : wide;
    const ints near_image = reaches_image(f->x, f->z, wide, cam->fx, cam->cx, cam->width) &
                            reaches_image(f->y, f->z, wide, cam->fy, cam->cy, cam->height);
    if (!ANY_LANE(kept & near_image)) return false;
    tangents(f->x, f->z, reach, cam->fx, cam->cx, cam->width, &first[0], &last[0]);
    tangents(f->y, f->z, reach, cam->fy, cam->cy, cam->height, &first[1], &last[1]);
    return true;
}

typedef struct {
    floats least;  // LEAST_RADIUS pixels at range t, world units
    floats reach;  // from the ray to the rim, world units
    ints tiny;     // the radius is below one pixel
    // reciprocals, since dividing 16 lanes by one number is slower than multiplying them
    floats per_reach;
    float per_fx, per_fy;
    float left, top;  // from the principal point to the centre of pixel (0, 0), pixels
} Rim;

ALWAYS_INLINE Rim footprints_rim(const Camera *cam, const Footprints *f) {
#pragma OPENCL FP_CONTRACT OFF
    Rim rim;
    const floats width = f->t / least_focal(cam);
    rim.least = LEAST_RADIUS * width;
    rim.reach = fmax(f->shape[0], rim.least);
    rim.tiny = f->shape[0] < width;
    rim.per_reach = 1.0f / rim.reach;
    rim.per_fx = reciprocal(cam->fx);
    rim.per_fy = reciprocal(cam->fy);
    rim.left = 0.5f - cam->cx;
    rim.top = 0.5f - cam->cy;
    return rim;
}

// Whether the rays (mx, my, 1) through pixels, of the squared length m2, pass the centres within
// `reach`; writes the squared distances.
//
// Differs from Pulsar, whose distance from the ray is that at the centre's range, whose depth is
// that of the sphere's front, up to a radius nearer, and whose d varies within every footprint of
// at least a pixel.
ALWAYS_INLINE ints disc_covers(
    const Footprints *f,
    const Rim *rim,
    const floats px,
    const floats py,
    floats *distance2) {
#pragma OPENCL FP_CONTRACT OFF
    const floats mx = (px + rim->left) * rim->per_fx, my = (py + rim->top) * rim->per_fy;
    const floats m2 = mx * mx + my * my + 1.0f;
    const floats ex = f->y - f->z * my, ey = f->z * mx - f->x, ez = f->x * my - f->y * mx;
    const floats across2 = square(ex, ey, ez);
    *distance2 = across2 / m2;
    return across2 < rim->reach * rim->reach * m2 && f->x * mx + f->y * my + f->z > 0.0f;
}

#endif
