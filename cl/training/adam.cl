// Adam (Kingma & Ba 2015, section 2, with the bias corrections folded into rate and eps on the
// host).
#include "common.h"
#include "lanes.h"
#include "layers/parts.h"

// 1 - beta; 1 - 0.999f would be off by 1e-5 of itself
#ifndef DECAY1
#define DECAY1 0.1f
#endif
#ifndef DECAY2
#define DECAY2 0.001f
#endif

// One work-item per part of a row of parts.h, where the parts of the gradients are: moves LANES
// parameters and their two moments one step.
kernel void adam_update(
    const uint n,  // rows of partial, of one part of all weights
    const uint rows,
    const float rate,               // learning rate * sqrt(1 - beta2^t) / (1 - beta1^t)
    const float eps,                // eps * sqrt(1 - beta2^t)
    global const int *table,        // (rows, 8) parts.h
    global const float16 *partial,  // (...) as there
    global float16 *parameter,      // (...) of all weights and biases
    global float16 *m,              // (...) first moment
    global float16 *v)              // (...) second moment
{
    const int item = get_global_id(0) / ROW_PARTS;
    if (item >= n) return;
    const Sum found = sum_of(table, rows, partial, item);
    const floats g = BOUNDED_GRADIENT(floats, found.sum);
    floats m_new = load_part(m, found.at), v_new = load_part(v, found.at);
    m_new += DECAY1 * (g - m_new);
    v_new += DECAY2 * (g * g - v_new);
    store_part(m_new, m, found.at);
    store_part(v_new, v, found.at);
    store_part(
        load_part(parameter, found.at) - rate * m_new / (sqrt(v_new) + eps), parameter, found.at);
}
