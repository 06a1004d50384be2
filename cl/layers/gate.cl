// The gate of a gated convolution (Yu et al. 2019, with the activation of ADOP): x holds the
// features and then the gates of each pixel, out = ELU(features) * sigmoid(gates). A work-item is
// (LANES channels, x, y) of out: one vector of a pixel, shorter at the last channels. It writes
// where its tile is computed (tiles.h).
#include "common.h"
#include "lanes.h"
#include "layers/tiles.h"

// x where it is not above 0, else 0. Comparing, not fmin, keeps NaN.
ALWAYS_INLINE floats negative_part(const floats x) {
    return select(x, (floats)0.0f, x > 0.0f);
}

// x above 0, else exp(x) - 1, for which a difference of exp(x) would cancel near 0.
ALWAYS_INLINE floats elu(const floats x) {
    return select(expm1(negative_part(x)), x, x > 0.0f);
}

// 1 / (1 + exp(-x)), from a power that cannot overflow: decay = exp(-|x|).
ALWAYS_INLINE floats sigmoid(const floats x, const floats decay) {
    return select(decay, (floats)1.0f, x >= 0.0f) / (1.0f + decay);
}

// One work-item per (LANES channels, x, y) of out: reads its features and gates, writes
// ELU(features) * sigmoid(gates).
kernel void gate_forward(
    const int h,
    const int w,
    const int c,
    global const float *x,           // (h, w, 2*c) features, gates
    global const float *tile_count,  // ((h+3)/4, (w+3)/4) of out, 0 = not computed
    global float *out)               // (h, w, c)
{
    const int first = get_global_id(0) * LANES, column = get_global_id(1), row = get_global_id(2),
              count = c - first;
    if (first >= c || column >= w || row >= h || !tile_is_computed(tile_count, column, row, w))
        return;
    const size_t pixel = (size_t)row * w + column;
    global const float *features = x + pixel * 2 * c + first;
    const floats gates = load_lanes(features + c, count);
    store_lanes(
        elu(load_lanes(features, count)) * sigmoid(gates, exp(-fabs(gates))),
        out + pixel * c + first, count);
}

// One work-item per (LANES channels, x, y) of out: reads features, gates and gradient, writes the
// gradients of features and gates.
kernel void gate_backward(
    const int h,
    const int w,
    const int c,
    global const float *x,           // (h, w, 2*c) features, gates
    global const float *tile_count,  // ((h+3)/4, (w+3)/4) of grad_x, 0 = not computed
    global const float *grad_out,    // (h, w, c)
    global float *grad_x)            // (h, w, 2*c)
{
    const int first = get_global_id(0) * LANES, column = get_global_id(1), row = get_global_id(2),
              count = c - first;
    if (first >= c || column >= w || row >= h || !tile_is_computed(tile_count, column, row, w))
        return;
    const size_t pixel = (size_t)row * w + column, at = pixel * 2 * c + first;
    const floats features = load_lanes(x + at, count), gates = load_lanes(x + at + c, count);
    const floats dL_dout = load_lanes(grad_out + pixel * c + first, count);
    const floats decay = exp(-fabs(gates)), open = sigmoid(gates, decay);
    // sigmoid' = sigmoid(x) sigmoid(-x); 1 - sigmoid(x) would cancel
    const floats closed = sigmoid(-gates, decay);
    store_lanes(dL_dout * open * exp(negative_part(features)), grad_x + at, count);
    store_lanes(dL_dout * elu(features) * (open * closed), grad_x + at + c, count);
}
