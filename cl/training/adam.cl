// Adam (Kingma & Ba 2015, section 2, with the bias corrections folded into rate and eps on the
// host) and averaged weights.
#include "camera.h"
#include "common.h"
#include "grid.h"
#include "training/half16.h"
#include "sh.h"
#include "vector.h"

#ifndef FIRST
#define FIRST 0  // of the SH coefficients in one array: its index in the basis
#endif
#ifndef K
#define K 1  // and their number
#endif

#ifndef LAZY
#define LAZY 0  // 1: only listed points are updated; 0: all, and nobody reads a list
#endif
#ifndef SCALE
#define SCALE 1.0f  // of moments in 16 bits
#endif

// 1 - beta, for 1 - 0.999f is off by 1e-5 of itself; pp_cl/training/adam.py knows the betas too
#define DECAY1 0.1f
#define DECAY2 0.001f

// New moments and the step of one value, or of 16: T is float or float16. rest: of adam_rest.
#define ADAM_STEP(T, name)                                                                         \
    static inline T name(                                                                          \
        const T g, const float4 rest, T *m, T *v, const float rate, const float eps) {             \
        const T missed = rest.z > 0.0f ? rest.z * rate * *m / (sqrt(*v) + eps) : (T)(0.0f);        \
        *m *= rest.x;                                                                              \
        *v *= rest.y;                                                                              \
        *m += DECAY1 * (g - *m);                                                                   \
        *v += DECAY2 * (g * g - *v);                                                               \
        return missed + rate * *m / (sqrt(*v) + eps);                                              \
    }
#define NO_REST (float4)(1.0f, 1.0f, 0.0f, 0.0f)  // no step missed
ADAM_STEP(float, adam_step)
ADAM_STEP(float16, adam_step16)

// One work-item per 16 values: moves a parameter and its two moments one step.
kernel void adam_update(
    const uint n,              // values
    const float rate,          // learning rate * sqrt(1 - beta2^t) / (1 - beta1^t)
    const float eps,           // eps * sqrt(1 - beta2^t)
    global const float *grad,  // (...) n values, as the next three
    global float *parameter,   // (...)
    global float *m,           // (...) first moment
    global float *v)           // (...) second moment
{
    const size_t i = 16 * get_global_id(0);
    if (i >= n) return;
    const int count = min(n - (uint)i, 16u);
    float16 m16 = load16(m + i, count), v16 = load16(v + i, count);
    const float16 step = adam_step16(load16(grad + i, count), NO_REST, &m16, &v16, rate, eps);
    store16(m16, m + i, count);
    store16(v16, v + i, count);
    store16(load16(parameter + i, count) - step, parameter + i, count);
}

// One work-item per seen point: writes whether it received a gradient; a NaN is one.
kernel void adam_touched(
    const uint s,                               // seen points
    global const uint *seen,                    // (S) their indices
    global const float16 *grad_point_features,  // (N, 16) only the seen are read
    global const float *grad_opacity,           // (N)
    global uint *touched)                       // (N) only the seen are written
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const uint i = seen[g];
    touched[i] = any(grad_point_features[i] != 0.0f) || grad_opacity[i] != 0.0f;
}

// One work-item per listed point: reads its last step, writes the present one, and what the k steps
// between, with gradients of 0, did: the decay of its moments, and how many times rate m/(sqrt(v) +
// eps) they would have moved it, sum over j = 1..k of rho^j with rho = beta1/sqrt(beta2).
kernel void adam_rest(
    const uint s,                // listed points
    const uint step,             // from 1
    const uint t,                // rows of the table
    const float log_beta2,       // log2(beta2)
    global const float4 *table,  // (T, 4) by k: beta1^k, beta2^k, moves, 0
    global const uint *rows,     // (S) their indices
    global uint *last,           // (N) step of the last update, 0: none
    global float4 *rest)         // (?, 4) S rows of the table
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const uint i = rows[g], k = step - last[i] - 1;
    float4 row = table[min(k, t - 1)];
    if (k >= t) row.y = exp2(k * log_beta2);
    rest[g] = row;
    last[i] = step;
}

static inline size_t row_of(global const uint *rows, const size_t g) {
    return LAZY ? rows[g] : g;
}

static inline float4 rest_of(global const float4 *rest, const size_t g) {
    return LAZY ? rest[g] : NO_REST;
}

// One work-item per listed point: moves its opacity, which stays in [0, 1], and the moments.
kernel void adam_opacity_update(
    const uint s,      // listed points, or all
    const float rate,  // as in adam_update
    const float eps,
    global const uint *rows,           // (?) their S indices
    global const float4 *rest,         // (?, 4) of adam_rest
    global const float *grad_opacity,  // (N) only the listed are read
    global float *opacity,             // (N)
    global float *m,                   // (N)
    global float *v)                   // (N)
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const size_t i = row_of(rows, g);
    float m1 = m[i], v1 = v[i];
    const float moved =
        opacity[i] - adam_step(grad_opacity[i], rest_of(rest, g), &m1, &v1, rate, eps);
    m[i] = m1;
    v[i] = v1;
    opacity[i] = moved < 0.0f ? 0.0f : moved > 1.0f ? 1.0f : moved;  // clamp() would hide a NaN
}

// Harmonics of the direction from the eye to a grid vertex.
static inline void
adam_basis(global const float *grid, global const float *camera, const uint id, float *basis) {
    const Camera view = camera_load(camera);
    const float3 direction = grid_position(grid, id) - view.eye;
    // normalize(0) is NaN on some devices
    sh_basis(direction * rsqrt(fmax(dot(direction, direction), FLT_MIN)), basis);
}

// One work-item per listed point: moves some of its SH coefficients and their moments one step.
// The gradient of coefficient k is basis[k] * grad_point_features and is never stored.
kernel void adam_sh_update(
    const uint s,      // listed points, or all
    const float rate,  // as in adam_update
    const float eps,
    global const uint *rows,                    // (?) their S indices
    global const float4 *rest,                  // (?, 4) of adam_rest
    global const float *grid,                   // (8)
    global const float *camera,                 // (20)
    global const uint *ids,                     // (N) grid ids
    global const float16 *grad_point_features,  // (N, 16) only the listed are read
    global float16 *sh,                         // (N, K, 16)
    global float16 *m,                          // (N, K, 16)
    global float16 *v)                          // (N, K, 16)
{
    const size_t g = get_global_id(0);
    if (g >= s) return;
    const size_t i = row_of(rows, g);
    const float4 missed = rest_of(rest, g);
    float basis[9];
    adam_basis(grid, camera, ids[i], basis);
    const float16 dL_df = grad_point_features[i];
    for (size_t k = 0; k < K; k++) {
        const size_t at = i * K + k;
        float16 m16 = m[at], v16 = v[at];
        sh[at] -= adam_step16(basis[FIRST + k] * dL_df, missed, &m16, &v16, rate, eps);
        m[at] = m16;
        v[at] = v16;
    }
}

// The same with SCALE * m and SCALE * sqrt(v) in 16 bits each: the square root halves the range of
// exponents of v.
kernel void adam_sh_update_half(
    const uint s,      // listed points, or all
    const uint seed,   // of the rounding: another one in each step
    const float rate,  // as in adam_update
    const float eps,
    global const uint *rows,                    // (?) their S indices
    global const float4 *rest,                  // (?, 4) of adam_rest
    global const float *grid,                   // (8)
    global const float *camera,                 // (20)
    global const uint *ids,                     // (N) grid ids
    global const float16 *grad_point_features,  // (N, 16) only the listed are read
    global float16 *sh,                         // (N, K, 16)
    global half *moments)                       // (N, K, 2, 16)
{
    const size_t g = get_global_id(0);
    if (g >= s) return;
    const size_t i = row_of(rows, g);
    const float4 missed = rest_of(rest, g);
    float basis[9];
    adam_basis(grid, camera, ids[i], basis);
    const float16 dL_df = SCALE * grad_point_features[i];
    for (size_t k = 0; k < K; k++) {
        const size_t at = i * K + k;
        global half *pair = moments + 32 * at;
        const float16 root = vload_half16(1, pair);
        float16 m16 = vload_half16(0, pair), v16 = root * root;
        sh[at] -= adam_step16(basis[FIRST + k] * dL_df, missed, &m16, &v16, rate, SCALE * eps);
        const uint16 random = random16(seed + 9 * (uint)i + FIRST + k);
        store_half16(m16, random >> 19, pair);
        store_half16(sqrt(v16), random >> 6, pair + 16);
    }
}

// One work-item per 16 values: moves an average towards a parameter.
kernel void ema_update(
    const uint n,                   // values
    const float weight,             // of the parameter
    global const float *parameter,  // (...) n values
    global float *average)          // (...) n values
{
    const size_t i = 16 * get_global_id(0);
    if (i >= n) return;
    const int count = min(n - (uint)i, 16u);
    const float16 a = load16(average + i, count);
    store16(a + weight * (load16(parameter + i, count) - a), average + i, count);
}
