// Exponential moving averages (EMA).
#include "common.h"
#include "lanes.h"

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
