// Adam (Kingma & Ba 2015, section 2, with the bias corrections folded into rate and eps on the
// host) and exponential moving averages (EMA).
#include "common.h"
#include "lanes.h"

// 1 - beta; 1 - 0.999f would be off by 1e-5 of itself
#ifndef DECAY1
#define DECAY1 0.1f
#endif
#ifndef DECAY2
#define DECAY2 0.001f
#endif

// New moments and the step of one value, or of LANES: T is float or floats.
#define ADAM_STEP(T, name)                                                                         \
    static inline T name(const T g, T *m, T *v, const float rate, const float eps) {               \
        *m += DECAY1 * (g - *m);                                                                   \
        *v += DECAY2 * (g * g - *v);                                                               \
        return rate * *m / (sqrt(*v) + eps);                                                       \
    }
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
    const floats step = adam_step_lanes(load_lanes(grad + i, count), &m_new, &v_new, rate, eps);
    store_lanes(m_new, m + i, count);
    store_lanes(v_new, v + i, count);
    store_lanes(load_lanes(parameter + i, count) - step, parameter + i, count);
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
    const float moved = opacity[i] - adam_step(grad_opacity[i], &m1, &v1, rate, eps);
    m[i] = m1;
    v[i] = v1;
    opacity[i] = moved < 0.0f ? 0.0f : moved > 1.0f ? 1.0f : moved;  // clamp() would hide a NaN
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
