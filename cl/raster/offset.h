// Gradients of the offsets of soft points and of Gaussians, composited by alpha: what moving and
// widening a point changes by the closeness d of its hits. How the order of hits and the harmonics
// change is left out.
//
// d = 1 - rho / h with rho = |e|, e = c - (c.r) r: of the centre c from the unit ray r
// dd/dc = -e / (rho h),   dL/dd = o/d dL/do (alpha.cl)
// With m along the ray, of any length: e = c - (c.m)/(m.m) m, which takes no root.
//
// dd/d(log h) = rho / h = 1 - d. The least h is not the point's own and grows with the range t = |c|:
// then dd/dc has rho/h^2 dh/dc = (1 - d) c/t^2 more instead.
//
// Gaussian: d = exp(-rho^2 / 2v), v = r^2 + LOW_PASS w^2, with the width w = z / f of a pixel
// dd/dc = -d e/v + d rho^2/v (LOW_PASS w^2/v) / z along the axis,   dd/d(log r) = d rho^2/v r^2/v
#ifndef PP_OFFSET_H
#define PP_OFFSET_H

#include "raster/footprint.h"

#define LEAST_RHO 1e-3f  // of h: nearer to its ray a point has no direction away from it

typedef struct {
    float3 centre;  // of the point, camera axes
    float per_fx, per_fy;
    float h;              // radius of its footprint, world units
    float growth;         // dh/dc = growth h c where h is the least one, else 0
    float variance, own;  // v of a Gaussian, and the share r^2/v of it
    float3 dL_dc;
    float dL_dlog;  // of h
} OffsetGradient;

// Nothing is summed yet. centre: in camera axes, with the range.
static inline OffsetGradient
offset_begin(const Camera *cam, const float4 centre, const float radius) {
    const float t = centre.w, h = fmax(radius, LEAST_RADIUS * t / least_focal(cam));
    OffsetGradient sum;
    sum.centre = centre.xyz;
    sum.per_fx = 1.0f / cam->fx;
    sum.per_fy = 1.0f / cam->fy;
    sum.h = h;
    sum.growth = h > radius ? 1.0f / (t * t) : 0.0f;
    sum.variance = VARIANCE(cam, radius, centre.z);
    sum.own = radius * radius / sum.variance;
    sum.dL_dc = 0.0f;
    sum.dL_dlog = 0.0f;
    return sum;
}

// Adds what one hit in pixel q says, of closeness d > 0.
static inline void
offset_add(OffsetGradient *sum, const Camera *cam, const uint q, const float d, const float dL_dd) {
    const float mx = (q % cam->width + 0.5f - cam->cx) * sum->per_fx;
    const float my = (q / cam->width + 0.5f - cam->cy) * sum->per_fy;
    const float3 m = (float3)(mx, my, 1.0f), c = sum->centre, e = c - dot(c, m) / dot(m, m) * m;
#if FOOTPRINT == GAUSSIAN
    const float exponent = dot(e, e) / sum->variance, dL = dL_dd * d;
    sum->dL_dlog += dL * exponent * sum->own;
    sum->dL_dc -= dL / sum->variance * e;
    sum->dL_dc.z += dL * exponent * (1.0f - sum->own) / c.z;
#else
    const float per_rho_h = 1.0f / (fmax(1.0f - d, LEAST_RHO) * sum->h * sum->h);
    sum->dL_dlog += dL_dd * (1.0f - d);
    sum->dL_dc += dL_dd * (sum->growth * (1.0f - d) * c - per_rho_h * e);
#endif
}

// Of the offset from the vertex, in edges of the grid, and of the logarithm of the radius.
static inline float4 offset_end(const OffsetGradient *sum, const Camera *cam, const float edge) {
    const float3 of = sum->dL_dc;
    const float3 world = edge * (of.x * cam->right + of.y * cam->down + of.z * cam->forward);
    const bool is_least = FOOTPRINT != GAUSSIAN && sum->growth > 0.0f;
    return (float4)(world, is_least ? 0.0f : sum->dL_dlog);
}

#endif
