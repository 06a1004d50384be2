// The soft disc: d = 1 - rho / h with rho = |e|, e = c - (c.r) r: of the centre c from the unit ray r
// dd/dc = -e / (rho h)
// With m along the ray, of any length: e = c - (c.m)/(m.m) m, which takes no root.
//
// dd/d(log h) = rho / h = 1 - d. The least h is not the point's own and grows with the range t =
// |c|: then dd/dc has rho/h^2 dh/dc = (1 - d) c/t^2 more instead.

#define LEAST_RHO 1e-3f  // of h: nearer to its ray a point has no direction away from it

typedef struct {
    float4 centre;  // of the point, camera axes
    float per_h2;   // 1 / h^2 of the radius of its footprint, world units
    float growth;   // dh/dc = growth h c where h is the least one, else 0
    floats dL_dx, dL_dy, dL_dz;
    floats dL_dlog;  // of h
} OffsetGradient;

ALWAYS_INLINE OffsetGradient
offset_begin(const Camera *cam, const float4 centre, global const float *shape) {
    const float t = centre.w, h = reach_of(cam, centre, shape[0]);
    OffsetGradient sum;
    sum.centre = centre;
    sum.per_h2 = 1.0f / (h * h);
    sum.growth = h > shape[0] ? 1.0f / (t * t) : 0.0f;
    sum.dL_dx = sum.dL_dy = sum.dL_dz = sum.dL_dlog = 0.0f;
    return sum;
}

ALWAYS_INLINE void offset_add(
    OffsetGradient *sum,
    const Camera *cam,
    const uint q,
    const Rays *m,
    const floats d,
    const floats dL_dd) {
    const float4 c = sum->centre;
    const floats rest = 1.0f - d, along = (c.x * m->x + c.y * m->y + c.z) / m->length2;
    const floats inward = dL_dd * sum->per_h2 / fmax(rest, LEAST_RHO);
    const floats outward = dL_dd * sum->growth * rest;
    sum->dL_dx += outward * c.x - inward * (c.x - along * m->x);
    sum->dL_dy += outward * c.y - inward * (c.y - along * m->y);
    sum->dL_dz += outward * c.z - inward * (c.z - along);
    sum->dL_dlog += dL_dd * rest;
}

ALWAYS_INLINE Offsets offset_end(
    const OffsetGradient *sum,
    const Camera *cam,
    const float voxel_size,
    const float radius,
    const Offsets offset) {
    const float3 world =
        voxel_size * (SUM_LANES(sum->dL_dx) * cam->right + SUM_LANES(sum->dL_dy) * cam->down +
                      SUM_LANES(sum->dL_dz) * cam->forward);
    return (Offsets)(world, sum->growth > 0.0f ? 0.0f : SUM_LANES(sum->dL_dlog));
}
