// Adam (Kingma & Ba 2015, section 2, with the bias corrections folded into rate and eps on the host) and averaged weights.
#include "camera.h"
#include "common.h"
#include "grid.h"
#include "sh.h"
#include "vector.h"

#ifndef DEGREE
#define DEGREE 2
#endif
#define K (2 * DEGREE + 1)       // coefficients of one degree
#define FIRST (DEGREE * DEGREE)  // the first of them in the basis

// New moments and the step of 16 values. The decays come as 1 - beta: 1 - 0.999f is off by 1e-5 of itself.
inline float16 adam_step(const float16 g, float16 *m, float16 *v,
                         const float decay1, const float decay2, const float rate, const float eps) {
    *m += decay1 * (g - *m);
    *v += decay2 * (g * g - *v);
    return rate * *m / (sqrt(*v) + eps);
}

// One work-item per 16 values: moves a parameter and its two moments one step, then clamps the parameter.
kernel void adam_update(
    const uint n,                         // values
    const float decay1,                   // 1 - beta1
    const float decay2,                   // 1 - beta2
    const float rate,                     // learning rate * sqrt(1 - beta2^t) / (1 - beta1^t)
    const float eps,                      // eps * sqrt(1 - beta2^t)
    const float low,                      // bounds of the parameter
    const float high,
    global const float *grad,             // (...) n values, as the next three
    global float *parameter,              // (...)
    global float *m,                      // (...) first moment
    global float *v)                      // (...) second moment
{
    const size_t i = 16 * get_global_id(0);
    if (i >= n)
        return;
    const int count = min(n - (uint)i, 16u);
    float16 m16 = load16(m + i, count), v16 = load16(v + i, count);
    const float16 step = adam_step(load16(grad + i, count), &m16, &v16, decay1, decay2, rate, eps);
    store16(m16, m + i, count);
    store16(v16, v + i, count);
    store16(clamp(load16(parameter + i, count) - step, low, high), parameter + i, count);
}

// One work-item per point: moves its SH coefficients of one degree and their moments one step.
// The gradient of coefficient k is basis[k] * grad_point_features and is never stored.
kernel void adam_sh_update(
    const uint n,                               // points
    const float decay1,                         // as in adam_update
    const float decay2,
    const float rate,
    const float eps,
    global const float *grid,                   // (8)
    global const float *camera,                 // (20)
    global const uint *ids,                     // (N) grid ids
    global const float16 *grad_point_features,  // (N, 16) 0 for unseen points
    global float16 *sh,                         // (N, K, 16)
    global float16 *m,                          // (N, K, 16)
    global float16 *v)                          // (N, K, 16)
{
    const size_t i = get_global_id(0);
    if (i >= n)
        return;
    const Camera view = camera_load(camera);
    float basis[9];
    const float3 direction = grid_position(grid, ids[i]) - view.eye;
    sh_basis(direction * rsqrt(fmax(dot(direction, direction), FLT_MIN)), basis);  // normalize(0) is NaN on some devices
    const float16 dL_df = grad_point_features[i];
    for (size_t k = 0; k < K; k++) {
        const size_t at = i * K + k;
        float16 m16 = m[at], v16 = v[at];
        sh[at] -= adam_step(basis[FIRST + k] * dL_df, &m16, &v16, decay1, decay2, rate, eps);
        m[at] = m16;
        v[at] = v16;
    }
}

// One work-item per 16 values: moves an average towards a parameter.
kernel void ema_update(
    const uint n,                         // values
    const float weight,                   // of the parameter
    global const float *parameter,        // (...) n values
    global float *average)                // (...) n values
{
    const size_t i = 16 * get_global_id(0);
    if (i >= n)
        return;
    const int count = min(n - (uint)i, 16u);
    const float16 a = load16(average + i, count);
    store16(a + weight * (load16(parameter + i, count) - a), average + i, count);
}
