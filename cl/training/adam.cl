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
    const floats g = load_lanes(grad + i, count);
    floats m_new = load_lanes(m + i, count), v_new = load_lanes(v + i, count);
    m_new += DECAY1 * (g - m_new);
    v_new += DECAY2 * (g * g - v_new);
    store_lanes(m_new, m + i, count);
    store_lanes(v_new, v + i, count);
    const floats moved = load_lanes(parameter + i, count) - rate * m_new / (sqrt(v_new) + eps);
    store_lanes(moved, parameter + i, count);
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
