// The Gaussian, in a pixel of one sample: d = exp(-|s|^2 / 2), s = W e with e from the centre u to
// the pixel; S = (W^T W)^-1 is the covariance on the screen. With w = W^T s = S^-1 e: dd/du = d w,
// dd/dS = d w w^T / 2
//
// S = A A^T + v I, A = M L, with the rows m of M below and G = sum dL/dd d w w^T:
// dL/dA = G A,   dL/dL = M^T dL/dA,   dL/dM = dL/dA L^T
// m_0 = fx/z (right - x/z forward): dm_0/dx = -fx/z^2 forward, dm_0/dz = -m_0/z + fx x/z^3 forward
//
// Of pixels that are means, d is that times sqrt(|S_0| / |S|), S_0 = A A^T + low_pass() I, whose
// logarithm's derivative by S is (S_0^-1 - S^-1) / 2: to G comes this difference times sum dL/dd d.

typedef struct {
    float3 centre;  // of the point, camera axes
    float2 place;   // the same on the screen, pixels
    float3 W;
    float2 dL_du;
    float3 G;      // xx, xy, yy
    float dL_dln;  // sum dL/dd d
} OffsetGradient;

static inline OffsetGradient
offset_begin(const Camera *cam, const float4 centre, global const float *shape) {
    OffsetGradient sum;
    sum.centre = centre.xyz;
    sum.place =
        (float2)(centre.x / centre.z * cam->fx + cam->cx, centre.y / centre.z * cam->fy + cam->cy);
    sum.W = vload3(0, shape);
    sum.dL_du = 0.0f;
    sum.G = 0.0f;
    sum.dL_dln = 0.0f;
    return sum;
}

static inline void offset_add(
    OffsetGradient *sum,
    const Camera *cam,
    const uint q,
    const Rays *m,
    const float d,
    const float dL_dd) {
    const float2 pixel = (float2)(q % cam->width + 0.5f, q / cam->width + 0.5f);
    const float2 e = pixel - sum->place;
    const float sx = sum->W.x * e.x + sum->W.y * e.y, sy = sum->W.z * e.y;
    const float2 w = (float2)(sum->W.x * sx, sum->W.y * sx + sum->W.z * sy);
    const float dL = dL_dd * d;
    sum->dL_du += dL * w;
    sum->G += dL * (float3)(w.x * w.x, w.x * w.y, w.y * w.y);
    sum->dL_dln += dL;
}

// (xx, xy, yy) of the inverse of A A^T + v I. a0, a1: the rows of A.
static inline float3 inverse_spread(const float3 a0, const float3 a1, const float v) {
    const float xx = dot(a0, a0), yy = dot(a1, a1);
    const float3 normal = cross(a0, a1);
    const float determinant = dot(normal, normal) + v * (xx + yy) + v * v;
    return (float3)(yy + v, -dot(a0, a1), xx + v) / determinant;
}

static inline Offsets offset_end(
    const OffsetGradient *sum,
    const Camera *cam,
    const float voxel_size,
    const float radius,
    const Offsets offset) {
    const float x = sum->centre.x, y = sum->centre.y, z = sum->centre.z;
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
    const float3 G = sum->G + sum->dL_dln * lowered;
    const float3 b0 = G.x * a0 + G.y * a1, b1 = G.y * a0 + G.z * a1;
    const float3 dL_dm0 = (float3)(dot(l0, b0), dot(l1, b0), dot(l2, b0));
    const float3 dL_dm1 = (float3)(dot(l0, b1), dot(l1, b1), dot(l2, b1));
    const float ahead0 = dot(dL_dm0, cam->forward), ahead1 = dot(dL_dm1, cam->forward);
    const float dL_dx = fx * (sum->dL_du.x - ahead0 / z);
    const float dL_dy = fy * (sum->dL_du.y - ahead1 / z);
    const float dL_dz = -(x * dL_dx + y * dL_dy + dot(dL_dm0, m0) + dot(dL_dm1, m1)) / z;
    const float3 place =
        voxel_size * (dL_dx * cam->right + dL_dy * cam->down + dL_dz * cam->forward);
    const float3 of_1 = m0.y * b0 + m1.y * b1, of_2 = m0.z * b0 + m1.z * b1;  // rows of dL/dL
    return (Offsets)(place, l0.x * (m0.x * b0.x + m1.x * b1.x), l1.y * of_1.y, l2.z * of_2.z,
                     radius * of_1.x, radius * of_2.x, radius * of_2.y, (float4)(0.0f),
                     (float3)(0.0f));
}
