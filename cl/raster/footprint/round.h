// What discs and soft discs share: points with a radius, in world units.
#ifndef PP_ROUND_H
#define PP_ROUND_H

#define FORM 1  // numbers of what points learn of their form, of which LOGS are logarithms
#define LOGS 1
#define LARGEST(radius) ((radius) * exp(MOST_OFFSET))  // of points that have one without offsets
#define CLAMPED 0                                      // features may be below 0
#define DEPTH(p) (p)->c.w                              // by which points are sorted
#define SHOWN_ALPHA(alpha, shows)                      // alphas are what they are

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
    const floats scale = z * z - reach * reach, root = reach * sqrt(u * u + scale);
    const floats low = (u * z - root) / scale * focal + (centre - 0.5f - MARGIN);
    const floats high = (u * z + root) / scale * focal + (centre - 0.5f + MARGIN);
    pixels_between(low, high, z > reach, size, first, last);
}

ALWAYS_INLINE bool
footprints_box(const Camera *cam, const floats form[FORM], const ints kept, Footprints *f) {
    const floats least = LEAST_RADIUS * f->t / least_focal(cam), reach = fmax(form[0], least);
    f->size = select(reach, -reach, least > form[0]);
    const ints near_image = reaches_image(f->x, f->z, reach, cam->fx, cam->cx, cam->width) &
                            reaches_image(f->y, f->z, reach, cam->fy, cam->cy, cam->height);
    if (!ANY_LANE(kept & near_image)) return false;
    tangents(f->x, f->z, reach, cam->fx, cam->cx, cam->width, &f->first[0], &f->last[0]);
    tangents(f->y, f->z, reach, cam->fy, cam->cy, cam->height, &f->first[1], &f->last[1]);
    return true;
}

typedef struct {
    ints covers;
    floats falloff;  // where it covers
    // of a soft disc with the centre c at rays m: rho / reach = 1 - falloff; c x m; 1 / its length
    floats rest, x, y, z, per_across;
} Coverage;

// Whether the rays pass the centre within the radius, by c x m, as |c|^2 |m|^2 - (c.m)^2 would
// cancel.
ALWAYS_INLINE Coverage coverage_at(const Rays *m, const Point *p) {
    const float4 c = p->c;
    const float reach = fabs(p->size), reach2 = reach * reach, per_reach = 1.0f / reach;
    Coverage at;
    at.x = FMA(-c.z, m->y, c.y);
    at.y = -FMA(-c.z, m->x, c.x);
    at.z = FMA(-c.y, m->x, c.x * m->y);
    // above 0, so that it has a root to divide by
    const floats across2 = FMA(at.x, at.x, FMA(at.y, at.y, FMA(at.z, at.z, 1e-30f)));
    at.covers = across2 < reach2 * m->length2;
    // a point farther from the eye's plane no ray passes behind the eye
    if (c.z * c.z < reach2) at.covers &= FMA(c.x, m->x, FMA(c.y, m->y, c.z)) > 0.0f;
#if FOOTPRINT == SOFT
    at.per_across = per_root(across2);
    at.rest = across2 * at.per_across * (m->per_length * per_reach);
    at.falloff = 1.0f - at.rest;
#else
    at.falloff = 1.0f;
#endif
    return at;
}

#endif
