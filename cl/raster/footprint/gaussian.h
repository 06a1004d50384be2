// The Gaussian of 3D Gaussian splatting, as its viewers draw it: d = exp(-|s|^2 / 2) with s the
// distance from the centre in deviations, on the screen, where its covariance is J C J^T + LOW_PASS
// I: C in space, J the derivative of the projection in the centre. Its depth is along the camera's
// axis. Of a pixel that is the mean of several of a viewer's, see widened().
//
// Its form is L of its covariance L L^T in world axes: its diagonal, then (1, 0), (2, 0), (2, 1).
// Its shape is W: deviations at (x, y) pixels from the centre are (W0 x + W1 y, W2 y).
//
// Its derivatives: d = p exp(-|s|^2 / 2), s = W e with e from the centre u to the pixel; S = (W^T
// W)^-1 is the covariance on the screen. With w = W^T s = S^-1 e: dd/du = d w, dd/dS = d w w^T / 2
//
// S = A A^T + v I, A = M L, with the rows m of M below and G = sum dL/dd d w w^T:
// dL/dA = G A,   dL/dL = M^T dL/dA,   dL/dM = dL/dA L^T
// m_0 = fx/z (right - x/z forward): dm_0/dx = -fx/z^2 forward, dm_0/dz = -m_0/z + fx x/z^3 forward
//
// Of pixels that are means, p = sqrt(|S_0| / |S|), S_0 = A A^T + low_pass() I, else 1. Its
// logarithm's derivative by S is (S_0^-1 - S^-1) / 2: to G comes this difference times sum dL/dd d.
#define FORM 6  // numbers of what points learn of their form, of which LOGS are logarithms
#define LOGS 3
#define LARGEST(radius) INFINITY  // no size is too large for one
#define CLAMPED 1                 // features below 0 count as 0, as viewers draw colours
#define DEPTH(p) (p)->c.z         // by which they are sorted
#define MOVES 1
#define surface_range(range, radius, d) (range)

#define LEAST_ALPHA (1.0f / 255.0f)  // of a fragment: below it viewers draw nothing
#define MOST_ALPHA 0.99f
#define SHOWN_ALPHA(alpha, shows)                                                                  \
    shows &= !(alpha < LEAST_ALPHA); /* a NaN shows */                                             \
    alpha = select(alpha, (floats)(MOST_ALPHA), alpha > MOST_ALPHA);

#define LOW_PASS 0.3f     // of a viewer's pixels^2
#define DEVIATIONS 3.33f  // to the rim, where an opaque one falls below LEAST_ALPHA

// What viewers add to the variances of a Gaussian, in pixels^2, and what a mean of viewers' pixels
// has besides: the variance of `samples` places in a row, 1 pixel in all. The mean over a pixel is
// nearly a Gaussian as wide that keeps the integral, with a lower peak.
static inline float low_pass(const Camera *cam) {
    return LOW_PASS / (cam->samples * cam->samples);
}

static inline float widened(const Camera *cam) {
    return low_pass(cam) + (1.0f - 1.0f / (cam->samples * cam->samples)) / 12.0f;
}

// First and last pixel that a Gaussian may cover along one axis, by its variance there.
ALWAYS_INLINE void pixels_by_variance(
    const floats centre,
    const floats variance,
    const float size,
    ints *first,
    ints *last) {
    const floats reach = DEVIATIONS * sqrt(variance);
    const floats low = centre - reach - (0.5f + MARGIN), high = centre + reach - (0.5f - MARGIN);
    pixels_between(low, high, variance > 0.0f, size, first, last);
}

// With the derivative J of the projection and A = J R L, the covariance S = A A^T + v I has the
// determinant |a_0 x a_1|^2 + v (|a_0|^2 + |a_1|^2) + v^2, a sum without cancellation. W is the
// inverse of a triangle U with S = U U^T for v = widened(), and the root of the determinant for v =
// low_pass() by that of S.
ALWAYS_INLINE bool
footprints_box(const Camera *cam, const floats form[FORM], const ints kept, Footprints *f) {
    if (!ANY_LANE(kept)) return false;
    const floats across[2] = {f->x / f->z, f->y / f->z};
    const floats scale[2] = {cam->fx / f->z, cam->fy / f->z};
    floats a[2][3];
    for (int row = 0; row < 2; row++) {
        const float3 axis = row ? cam->down : cam->right;
        const floats m0 = scale[row] * (axis.x - across[row] * cam->forward.x);
        const floats m1 = scale[row] * (axis.y - across[row] * cam->forward.y);
        const floats m2 = scale[row] * (axis.z - across[row] * cam->forward.z);
        a[row][0] = m0 * form[0] + m1 * form[3] + m2 * form[4];
        a[row][1] = m1 * form[1] + m2 * form[5];
        a[row][2] = m2 * form[2];
    }
    const floats xx = square(a[0][0], a[0][1], a[0][2]), yy = square(a[1][0], a[1][1], a[1][2]);
    const floats xy = a[0][0] * a[1][0] + a[0][1] * a[1][1] + a[0][2] * a[1][2];
    const floats wide = square(
        a[0][1] * a[1][2] - a[0][2] * a[1][1], a[0][2] * a[1][0] - a[0][0] * a[1][2],
        a[0][0] * a[1][1] - a[0][1] * a[1][0]);
    const float least = low_pass(cam), v = widened(cam);
    const floats root = sqrt(wide + v * (xx + yy) + v * v);
    f->W[2] = 1.0f / sqrt(yy + v);
    f->W[0] = 1.0f / (root * f->W[2]);
    f->W[1] = -xy * f->W[2] / root;
    f->size = sqrt(wide + least * (xx + yy) + least * least) / root;
    f->centre[0] = across[0] * cam->fx + cam->cx;
    f->centre[1] = across[1] * cam->fy + cam->cy;
    pixels_by_variance(f->centre[0], xx + v, cam->width, &f->first[0], &f->last[0]);
    pixels_by_variance(f->centre[1], yy + v, cam->height, &f->first[1], &f->last[1]);
    return true;
}

typedef struct {
    ints covers;
    floats falloff;
    floats w[2];  // W^T s
} Coverage;

ALWAYS_INLINE Coverage coverage_at(const Rays *m, const Point *p) {
    const floats dx = m->column - p->centre.x, dy = m->row - p->centre.y;
    const floats sx = FMA(p->W.x, dx, p->W.y * dy), sy = p->W.z * dy;
    const floats s2 = FMA(sx, sx, sy * sy);
    Coverage at;
    at.covers = s2 < DEVIATIONS * DEVIATIONS;
    at.falloff = p->size * exp(-0.5f * s2);
    at.w[0] = p->W.x * sx;
    at.w[1] = p->W.y * sx + p->W.z * sy;
    return at;
}

// sums: dL/du, dL/dS as xx, xy, yy; both without the opacity. shift: dL/dalpha.
ALWAYS_INLINE void derivatives_add(
    floats sums[5],
    const Rays *m,
    const Point *p,
    const Coverage *at,
    const floats shift) {
    const floats dL = shift * at->falloff;
    sums[0] += dL * at->w[0];
    sums[1] += dL * at->w[1];
    sums[2] += dL * at->w[0] * at->w[0];
    sums[3] += dL * at->w[0] * at->w[1];
    sums[4] += dL * at->w[1] * at->w[1];
}

// (xx, xy, yy) of the inverse of A A^T + v I. a0, a1: the rows of A.
static inline float3 inverse_spread(const float3 a0, const float3 a1, const float v) {
    const float xx = dot(a0, a0), yy = dot(a1, a1);
    const float3 normal = cross(a0, a1);
    const float determinant = dot(normal, normal) + v * (xx + yy) + v * v;
    return (float3)(yy + v, -dot(a0, a1), xx + v) / determinant;
}

// sums: of the samples. dL_dln: sum dL/dd d.
static inline Offsets derivatives_end(
    const float sums[5],
    const float dL_dln,
    const Camera *cam,
    const Point *p,
    const float voxel_size,
    const float radius,
    const Offsets offset) {
    const float x = p->c.x, y = p->c.y, z = p->c.z;
    const float2 dL_du = p->opacity * (float2)(sums[0], sums[1]);
    const float fx = cam->fx / z, fy = cam->fy / z;
    const float3 m0 = fx * (cam->right - x / z * cam->forward);
    const float3 m1 = fy * (cam->down - y / z * cam->forward);
    // the rows of L
    const float3 l0 = radius * (float3)(exp(offset.s3), 0.0f, 0.0f);
    const float3 l1 = radius * (float3)(offset.s6, exp(offset.s4), 0.0f);
    const float3 l2 = radius * (float3)(offset.s7, offset.s8, exp(offset.s5));
    const float3 a0 = m0.x * l0 + m0.y * l1 + m0.z * l2, a1 = m1.x * l0 + m1.y * l1 + m1.z * l2;
    const float3 lowered =
        inverse_spread(a0, a1, low_pass(cam)) - inverse_spread(a0, a1, widened(cam));
    const float3 G = p->opacity * (float3)(sums[2], sums[3], sums[4]) + dL_dln * lowered;
    const float3 b0 = G.x * a0 + G.y * a1, b1 = G.y * a0 + G.z * a1;
    const float3 dL_dm0 = (float3)(dot(l0, b0), dot(l1, b0), dot(l2, b0));
    const float3 dL_dm1 = (float3)(dot(l0, b1), dot(l1, b1), dot(l2, b1));
    const float ahead0 = dot(dL_dm0, cam->forward), ahead1 = dot(dL_dm1, cam->forward);
    const float dL_dx = fx * (dL_du.x - ahead0 / z);
    const float dL_dy = fy * (dL_du.y - ahead1 / z);
    const float dL_dz = -(x * dL_dx + y * dL_dy + dot(dL_dm0, m0) + dot(dL_dm1, m1)) / z;
    const float3 place =
        voxel_size * (dL_dx * cam->right + dL_dy * cam->down + dL_dz * cam->forward);
    const float3 of_1 = m0.y * b0 + m1.y * b1, of_2 = m0.z * b0 + m1.z * b1;  // rows of dL/dL
    return (Offsets)(place, l0.x * (m0.x * b0.x + m1.x * b1.x), l1.y * of_1.y, l2.z * of_2.z,
                     radius * of_1.x, radius * of_2.x, radius * of_2.y, (float4)(0.0f),
                     (float3)(0.0f));
}
