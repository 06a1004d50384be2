// The soft disc (ours): d = 1 - rho / h falls linearly from the centre to the rim of radius h, where
// rho = |e| is the distance of the centre c from the ray r: dd/dc = -e / (rho h).
//
// With m along the ray, of any length: e = m x (c x m) / (m.m), which does not cancel as c - (c.m) m
// / (m.m) does.
//
// dd/d(log h) = rho / h = 1 - d. The least h is not the point's own and grows with the range t =
// |c|: then dd/dc has rho/h^2 dh/dc = (1 - d) c/t^2 more instead.
#include "raster/footprint/round.h"

#define MOVES 1

// 1 / (rho / h): nearer to its ray a point has no direction away from it
#define MOST_PER_REST 1e3f

// sums: dL/d(log h), -h dL/dc; both without the opacity. shift: dL/dalpha.
ALWAYS_INLINE void derivatives_add(
    floats sums[4],
    const Rays *m,
    const Point *p,
    const Coverage *at,
    const floats shift) {
    // shift / (rho / h) / (h length2): e / rho is u m x (c x m)
    floats u = at->per_across * (m->length2 * m->per_length);
    const floats most = MOST_PER_REST / fabs(p->size);
    u = shift * select(u, most, u > most) * (m->per_length * m->per_length);
    sums[0] += shift * at->rest;
    sums[1] -= u * FMA(-m->y, at->z, at->y);
    sums[2] += u * FMA(-m->x, at->z, at->x);
    sums[3] += u * FMA(-m->y, at->x, m->x * at->y);
}

// sums: of the samples. dL_dln: sum dL/dd d, which only Gaussians need.
static inline Offsets derivatives_end(
    const float sums[4],
    const float dL_dln,
    const Camera *cam,
    const Point *p,
    const float voxel_size,
    const float radius,
    const Offsets offset) {
    const bool grows = p->size < 0.0f;
    const float outward = grows ? sums[0] / (p->c.w * p->c.w) : 0.0f;
    const float3 away = (float3)(sums[1], sums[2], sums[3]) / fabs(p->size);
    const float3 dL_dc = -p->opacity * (away - outward * p->c.xyz);
    const float3 world = dL_dc.x * cam->right + dL_dc.y * cam->down + dL_dc.z * cam->forward;
    return (Offsets)(voxel_size * world, grows ? 0.0f : p->opacity * sums[0]);
}

// The surface is that of the ball. d: at the rim a rounding below 0.
ALWAYS_INLINE floats surface_range(const float range, const float radius, const floats d) {
    return range - radius * sqrt(select(d * (2.0f - d), (floats)(0.0f), d < 0.0f));
}
