// The Gaussian of 3D Gaussian splatting, as its viewers draw it: d = exp(-|s|^2 / 2) with s the
// distance from the centre in deviations, on the screen, where its covariance is J C J^T + LOW_PASS
// I: C in space, J the derivative of the projection in the centre. Its depth is along the camera's
// axis. Of a pixel that is the mean of several of a viewer's, see widened().
//
// Its form is L of its covariance L L^T in world axes: its diagonal, then (1, 0), (2, 0), (2, 1).
// Its shape is W: deviations at (x, y) pixels from the centre are (W0 x + W1 y, W2 y), and the
// falloff in the centre is W3.
#define FORM 6  // numbers of what points learn of their form, of which LOGS are logarithms
#define LOGS 3
#define LARGEST(radius) INFINITY     // no size is too large for one
#define CLAMPED 1                    // features below 0 count as 0, as viewers draw colours
#define LEAST_ALPHA (1.0f / 255.0f)  // of a fragment: below it viewers draw nothing
#define MOST_ALPHA 0.99f
#define surface_range(range, radius, d) (range)

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
    pixels_between(low, high, variance > 0.0f, size, 0, first, last);
}

// With the derivative J of the projection and A = J R L, the covariance S = A A^T + v I has the
// determinant |a_0 x a_1|^2 + v (|a_0|^2 + |a_1|^2) + v^2, a sum without cancellation. W is the
// inverse of a triangle U with S = U U^T for v = widened(), and the root of the determinant for v =
// low_pass() by that of S.
ALWAYS_INLINE bool footprints_box(
    const Camera *cam,
    const floats form[FORM],
    const ints kept,
    Footprints *f,
    ints first[2],
    ints last[2]) {
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
    f->shape[2] = 1.0f / sqrt(yy + v);
    f->shape[0] = 1.0f / (root * f->shape[2]);
    f->shape[1] = -xy * f->shape[2] / root;
    f->shape[3] = sqrt(wide + least * (xx + yy) + least * least) / root;
    pixels_by_variance(across[0] * cam->fx + cam->cx, xx + v, cam->width, &first[0], &last[0]);
    pixels_by_variance(across[1] * cam->fy + cam->cy, yy + v, cam->height, &first[1], &last[1]);
    return true;
}

typedef struct {
    floats u, v;  // the centre, pixels
} Rim;

ALWAYS_INLINE Rim footprints_rim(const Camera *cam, const Footprints *f) {
#pragma OPENCL FP_CONTRACT OFF
    Rim rim;
    rim.u = f->x / f->z * cam->fx + cam->cx;
    rim.v = f->y / f->z * cam->fy + cam->cy;
    return rim;
}

ALWAYS_INLINE Coverage
footprints_cover(const Footprints *f, const Rim *rim, const floats px, const floats py) {
#pragma OPENCL FP_CONTRACT OFF
    const floats dx = px + 0.5f - rim->u, dy = py + 0.5f - rim->v;
    const floats sx = f->shape[0] * dx + f->shape[1] * dy, sy = f->shape[2] * dy;
    const floats s2 = sx * sx + sy * sy;
    return (Coverage){s2 < DEVIATIONS * DEVIATIONS, f->shape[3] * exp(-0.5f * s2), f->z};
}
