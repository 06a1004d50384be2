// Adam (Kingma & Ba 2015, section 2, with the bias corrections folded into rate and eps on the
// host) and exponential moving averages (EMA).
#include "camera.h"
#include "common.h"
#include "grid.h"
#include "lanes.h"
#include "sh.h"
#include "training/half16.h"

#ifndef SH_FIRST
#define SH_FIRST 0  // basis function of the first SH coefficient in one array
#endif
#ifndef SH_COUNT
#define SH_COUNT 1  // coefficients in it
#endif

#ifndef LAZY
#define LAZY 0  // 1: SH of the points in `rows`; 0: of all, `rows` and `skipped` are not read
#endif
#ifndef SCALE
#define SCALE 1.0f  // of moments in 16 bits
#endif

// 1 - beta; 1 - 0.999f would be off by 1e-5 of itself
#ifndef DECAY1
#define DECAY1 0.1f
#endif
#ifndef DECAY2
#define DECAY2 0.001f
#endif

// New moments and the step of one value, or of LANES: T is float or floats. skipped: of
// adam_skipped.
#define ADAM_STEP(T, name)                                                                         \
    static inline T name(                                                                          \
        const T g, const float4 skipped, T *m, T *v, const float rate, const float eps) {          \
        const T caught_up =                                                                        \
            skipped.z > 0.0f ? skipped.z * rate * *m / (sqrt(*v) + eps) : (T)(0.0f);               \
        *m *= skipped.x;                                                                           \
        *v *= skipped.y;                                                                           \
        *m += DECAY1 * (g - *m);                                                                   \
        *v += DECAY2 * (g * g - *v);                                                               \
        return caught_up + rate * *m / (sqrt(*v) + eps);                                           \
    }
#define NOTHING_SKIPPED (float4)(1.0f, 1.0f, 0.0f, 0.0f)
ADAM_STEP(float, adam_step)
ADAM_STEP(floats, adam_step_lanes)

// One work-item per LANES values: moves a parameter and its two moments one step.
kernel void adam_update(
    const uint n,              // values
    const float rate,          // learning rate * sqrt(1 - beta2^t) / (1 - beta1^t)
    const float eps,           // eps * sqrt(1 - beta2^t)
    global const float *grad,  // (...) n values, as the next three
    global float *parameter,   // (...)
    global float *m,           // (...) first moment
    global float *v)           // (...) second moment
{
    const size_t i = LANES * get_global_id(0);
    if (i >= n) return;
    const int count = min(n - (uint)i, (uint)LANES);
    floats m_new = load_lanes(m + i, count), v_new = load_lanes(v + i, count);
    const floats step =
        adam_step_lanes(load_lanes(grad + i, count), NOTHING_SKIPPED, &m_new, &v_new, rate, eps);
    store_lanes(m_new, m + i, count);
    store_lanes(v_new, v + i, count);
    store_lanes(load_lanes(parameter + i, count) - step, parameter + i, count);
}

// One work-item per shaded point: writes whether it received a gradient; a NaN is one.
kernel void adam_flag_gradients(
    const uint s,                               // shaded points
    global const uint *shaded,                  // (S) their indices
    global const float16 *grad_point_features,  // (N, 16) only the shaded are read
    global uint *has_gradient)                  // (N) only the shaded are written
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const uint i = shaded[g];
    has_gradient[i] = any(grad_point_features[i] != 0.0f);
}

// One work-item per listed point: reads its last step, and writes what the k steps between, with
// gradients of 0, did: the decay of its moments, and how many times rate m/(sqrt(v) + eps) they
// would have moved it, sum over j = 1..k of rho^j with rho = beta1/sqrt(beta2).
kernel void adam_skipped(
    const uint s,                        // listed points
    const uint step,                     // from 1
    const uint updating,                 // 1: `step` becomes their last step; 0: it stays
    const uint t,                        // rows of the table
    const float log_beta2,               // log2(beta2)
    global const float4 *skipped_steps,  // (T, 4) by k: beta1^k, beta2^k, moves, 0
    global const uint *rows,             // (S) their indices
    global uint *last_step,              // (N) of each point's last update, 0: none
    global float4 *skipped)              // (?, 4) S rows of the table
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const uint i = rows[g], k = step - last_step[i] - 1;
    float4 row = skipped_steps[min(k, t - 1)];
    if (k >= t) row.y = exp2(k * log_beta2);
    skipped[g] = row;
    if (updating) last_step[i] = step;
}

static inline size_t updated_point(global const uint *rows, const size_t g) {
    return LAZY ? rows[g] : g;
}

static inline float4 skipped_of(global const float4 *skipped, const size_t g) {
    return LAZY ? skipped[g] : NOTHING_SKIPPED;
}

// One work-item per point: moves its opacity, which stays in [0, 1], and the moments.
kernel void adam_opacity_update(
    const uint n,      // points
    const float rate,  // as in adam_update
    const float eps,
    global const float *grad_opacity,  // (N)
    global float *opacity,             // (N)
    global float *m,                   // (N)
    global float *v)                   // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    float m1 = m[i], v1 = v[i];
    const float moved =
        opacity[i] - adam_step(grad_opacity[i], NOTHING_SKIPPED, &m1, &v1, rate, eps);
    m[i] = m1;
    v[i] = v1;
    opacity[i] = moved < 0.0f ? 0.0f : moved > 1.0f ? 1.0f : moved;  // clamp() would hide a NaN
}

// Harmonics of the direction from the eye to a grid vertex.
static inline void
adam_basis(global const float *grid, global const float *camera, const uint id, float *basis) {
    const Camera cam = camera_load(camera);
    const float3 direction = grid_position(grid, id) - cam.eye;
    // normalize(0) is NaN on some devices
    sh_basis(direction * rsqrt(fmax(dot(direction, direction), FLT_MIN)), basis);
}

// Body of the two kernels below: moves SH_COUNT coefficients of point i and their moments one step.
// The gradient of coefficient k is basis[k] * grad_point_features and is never stored. LOAD and
// STORE read and write row `at` of the moments, as m_new = SCALE * m and v_new = SCALE^2 * v.
#define SH_UPDATE(LOAD, STORE)                                                                     \
    const size_t g = get_global_id(0) / ROW_PARTS;                                                 \
    if (g >= s) return;                                                                            \
    const size_t i = updated_point(rows, g);                                                       \
    float basis[9];                                                                                \
    adam_basis(grid, camera, ids[i], basis);                                                       \
    const float4 caught_up = skipped_of(skipped, g);                                               \
    const floats dL_df = SCALE * load_part(grad_point_features, i);                                \
    UNROLLED for (size_t k = 0; k < SH_COUNT; k++) {                                               \
        const size_t at = i * SH_COUNT + k;                                                        \
        floats m_new, v_new;                                                                       \
        LOAD;                                                                                      \
        const floats step = adam_step_lanes(                                                       \
            basis[SH_FIRST + k] * dL_df, caught_up, &m_new, &v_new, rate, SCALE * eps);            \
        store_part(load_part(sh, at) - step, sh, at);                                              \
        STORE;                                                                                     \
    }

// One work-item per part of an updated point: moves SH coefficients and their moments in 32 bits.
kernel void adam_sh_update(
    const uint s,      // updated points
    const float rate,  // as in adam_update
    const float eps,
    global const uint *rows,                    // (?) their S indices
    global const float4 *skipped,               // (?, 4) of adam_skipped
    global const float *grid,                   // (8)
    global const float *camera,                 // (20) camera.h
    global const uint *ids,                     // (N) grid ids
    global const float16 *grad_point_features,  // (N, 16) only those of updated points are read
    global float16 *sh,                         // (N, SH_COUNT, 16)
    global float16 *m,                          // (N, SH_COUNT, 16)
    global float16 *v)                          // (N, SH_COUNT, 16)
{
    SH_UPDATE(
        (m_new = load_part(m, at), v_new = load_part(v, at)),
        (store_part(m_new, m, at), store_part(v_new, v, at)));
}

// SCALE * m and SCALE * sqrt(v) of one coefficient: the square root halves the range of exponents.
ALWAYS_INLINE void moments_load(global const half *mv, const size_t at, floats *m, floats *v) {
    const floats root = load_half_part(mv, 2 * at + 1);
    *m = load_half_part(mv, 2 * at);
    *v = root * root;
}

ALWAYS_INLINE void moments_store(
    const floats m,
    const floats v,
    const uints random,
    global half *mv,
    const size_t at) {
    store_half_part(m, random >> 19, mv, 2 * at);
    store_half_part(sqrt(v), random >> 6, mv, 2 * at + 1);
}

// One work-item per part of an updated point: moves SH coefficients and their moments in 16 bits.
kernel void adam_sh_update_16bit(
    const uint s,      // updated points
    const uint seed,   // of the rounding: another one in each step
    const float rate,  // as in adam_update
    const float eps,
    global const uint *rows,                    // (?) their S indices
    global const float4 *skipped,               // (?, 4) of adam_skipped
    global const float *grid,                   // (8)
    global const float *camera,                 // (20) camera.h
    global const uint *ids,                     // (N) grid ids
    global const float16 *grad_point_features,  // (N, 16) only those of updated points are read
    global float16 *sh,                         // (N, SH_COUNT, 16)
    global half *mv)                            // (N, SH_COUNT, 2, 16)
{
    SH_UPDATE(
        moments_load(mv, at, &m_new, &v_new),
        moments_store(m_new, v_new, random_part(seed + 9 * (uint)i + SH_FIRST + k), mv, at));
}

// Body of the two kernels below: adds what the skipped steps of point i have yet to move its
// features by, as the next update will. LOAD: as above.
#define SH_PENDING(LOAD)                                                                           \
    const size_t g = get_global_id(0) / ROW_PARTS;                                                 \
    if (g >= s) return;                                                                            \
    const float moves = skipped[g].z;                                                              \
    if (moves == 0.0f) return;                                                                     \
    const size_t i = rows[g];                                                                      \
    float basis[9];                                                                                \
    adam_basis(grid, camera, ids[i], basis);                                                       \
    floats f = load_part(point_features, i);                                                       \
    UNROLLED for (size_t k = 0; k < SH_COUNT; k++) {                                               \
        const size_t at = i * SH_COUNT + k;                                                        \
        floats m_new, v_new;                                                                       \
        LOAD;                                                                                      \
        f -= basis[SH_FIRST + k] * (moves * rate * m_new / (sqrt(v_new) + SCALE * eps));           \
    }                                                                                              \
    store_part(f, point_features, i);

// One work-item per part of a listed point: its features with pending moves, moments in 32 bits.
kernel void adam_sh_pending(
    const uint s,      // listed points
    const float rate,  // as in adam_update
    const float eps,
    global const uint *rows,         // (S) their indices
    global const float4 *skipped,    // (?, 4) of adam_skipped
    global const float *grid,        // (8)
    global const float *camera,      // (20) camera.h
    global const uint *ids,          // (N) grid ids
    global const float16 *m,         // (N, SH_COUNT, 16)
    global const float16 *v,         // (N, SH_COUNT, 16)
    global float16 *point_features)  // (N, 16) only the listed rows are read and written
{
    SH_PENDING((m_new = load_part(m, at), v_new = load_part(v, at)));
}

// The same with moments in 16 bits.
kernel void adam_sh_pending_16bit(
    const uint s,      // listed points
    const float rate,  // as in adam_update
    const float eps,
    global const uint *rows,         // (S) their indices
    global const float4 *skipped,    // (?, 4) of adam_skipped
    global const float *grid,        // (8)
    global const float *camera,      // (20) camera.h
    global const uint *ids,          // (N) grid ids
    global const half *mv,           // (N, SH_COUNT, 2, 16)
    global float16 *point_features)  // (N, 16) only the listed rows are read and written
{
    SH_PENDING(moments_load(mv, at, &m_new, &v_new));
}

// One work-item per LANES values: moves an EMA towards a parameter.
kernel void ema_update(
    const uint n,                   // values
    const float weight,             // of the parameter
    global const float *parameter,  // (...) n values
    global float *ema)              // (...) n values
{
    const size_t i = LANES * get_global_id(0);
    if (i >= n) return;
    const int count = min(n - (uint)i, (uint)LANES);
    const floats a = load_lanes(ema + i, count);
    store_lanes(a + weight * (load_lanes(parameter + i, count) - a), ema + i, count);
}
