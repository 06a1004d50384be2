// The soft disc (ours): d falls linearly from the centre to the rim.
#include "raster/footprint/round.h"

ALWAYS_INLINE Coverage
footprints_cover(const Footprints *f, const Rim *rim, const floats px, const floats py) {
#pragma OPENCL FP_CONTRACT OFF
    floats distance2;
    const ints covers = disc_covers(f, rim, px, py, &distance2);
    return (Coverage){covers, 1.0f - sqrt(distance2) * rim->per_reach, f->t};
}

// The surface is that of the ball. d: at the rim a rounding below 0.
static inline float surface_range(const float range, global const float *shape, const float d) {
    return d < 0.0f ? range : range - shape[0] * sqrt(d * (2.0f - d));
}

// d = 1 - rho / h with rho = |e|, e = c - (c.r) r: of the centre c from the unit ray r
// dd/dc = -e / (rho h)
// With m along the ray, of any length: e = c - (c.m)/(m.m) m, which takes no root.
//
// dd/d(log h) = rho / h = 1 - d. The least h is not the point's own and grows with the range t =
// |c|: then dd/dc has rho/h^2 dh/dc = (1 - d) c/t^2 more instead.

#define LEAST_RHO 1e-3f  // of h: nearer to its ray a point has no direction away from it

typedef struct {
    float3 centre;  // of the point, camera axes
    float per_fx, per_fy;
    float h;       // radius of its footprint, world units
    float growth;  // dh/dc = growth h c where h is the least one, else 0
    float3 dL_dc;
    float dL_dlog;  // of h
} OffsetGradient;

static inline OffsetGradient
offset_begin(const Camera *cam, const float4 centre, global const float *shape) {
    const float t = centre.w, h = fmax(shape[0], LEAST_RADIUS * t / least_focal(cam));
    OffsetGradient sum;
    sum.centre = centre.xyz;
    sum.per_fx = 1.0f / cam->fx;
    sum.per_fy = 1.0f / cam->fy;
    sum.h = h;
    sum.growth = h > shape[0] ? 1.0f / (t * t) : 0.0f;
    sum.dL_dc = 0.0f;
    sum.dL_dlog = 0.0f;
    return sum;
}

static inline void
offset_add(OffsetGradient *sum, const Camera *cam, const uint q, const float d, const float dL_dd) {
    const float mx = (q % cam->width + 0.5f - cam->cx) * sum->per_fx;
    const float my = (q / cam->width + 0.5f - cam->cy) * sum->per_fy;
    const float3 m = (float3)(mx, my, 1.0f), c = sum->centre, e = c - dot(c, m) / dot(m, m) * m;
    const float per_rho_h = 1.0f / (fmax(1.0f - d, LEAST_RHO) * sum->h * sum->h);
    sum->dL_dlog += dL_dd * (1.0f - d);
    sum->dL_dc += dL_dd * (sum->growth * (1.0f - d) * c - per_rho_h * e);
}

static inline Offsets offset_end(
    const OffsetGradient *sum,
    const Camera *cam,
    const float voxel_size,
    const float radius,
    const Offsets offset) {
    const float3 of = sum->dL_dc;
    const float3 world = voxel_size * (of.x * cam->right + of.y * cam->down + of.z * cam->forward);
    return (Offsets)(world, sum->growth > 0.0f ? 0.0f : sum->dL_dlog);
}
