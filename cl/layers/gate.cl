// The gate of a gated convolution (Yu et al. 2019, with the activation of ADOP): x holds the
// features and then the gates of each pixel, out = ELU(features) * sigmoid(gates). A work-item is
// (16 channels, x, y) of out: one vector of a pixel, shorter at the last channels. It writes where
// its tile is computed (tiles.h).
#include "common.h"
#include "layers/tiles.h"
#include "vector.h"

// x where it is not above 0, else 0. Comparing, not fmin, keeps NaN.
ALWAYS_INLINE float16 negative_part(const float16 x) {
    return select(x, (float16)0.0f, x > 0.0f);
}

// x above 0, else exp(x) - 1, for which a difference of exp(x) would cancel near 0.
ALWAYS_INLINE float16 elu(const float16 x) {
    return select(expm1(negative_part(x)), x, x > 0.0f);
}

// 1 / (1 + exp(-x)), from a power that cannot overflow: decay = exp(-|x|).
ALWAYS_INLINE float16 sigmoid(const float16 x, const float16 decay) {
    return select(decay, (float16)1.0f, x >= 0.0f) / (1.0f + decay);
}

// One work-item per (16 channels, x, y) of out: reads its features and gates, writes ELU(features)
// * sigmoid(gates).
kernel void gate_forward(
    const int h,
    const int w,
    const int c,
    global const float *x,           // (h, w, 2*c) features, gates
    global const float *tile_count,  // (?, ?) of out, 0 = not computed
    global float *out)               // (h, w, c)
{
    const int first = get_global_id(0) * CHANNELS, column = get_global_id(1),
              row = get_global_id(2), lanes = c - first;
    if (first >= c || column >= w || row >= h || !tile_is_computed(tile_count, column, row, w))
        return;
    const size_t pixel = (size_t)row * w + column;
    global const float *features = x + pixel * 2 * c + first;
    const float16 gates = load16(features + c, lanes);
    store16(
        elu(load16(features, lanes)) * sigmoid(gates, exp(-fabs(gates))), out + pixel * c + first,
        lanes);
}

// One work-item per (16 channels, x, y) of out: reads features, gates and gradient, writes the
// gradients of features and gates.
kernel void gate_backward(
    const int h,
    const int w,
    const int c,
    global const float *x,           // (h, w, 2*c) features, gates
    global const float *tile_count,  // (?, ?) of grad_x, 0 = not computed
    global const float *grad_out,    // (h, w, c)
    global float *grad_x)            // (h, w, 2*c)
{
    const int first = get_global_id(0) * CHANNELS, column = get_global_id(1),
              row = get_global_id(2), lanes = c - first;
    if (first >= c || column >= w || row >= h || !tile_is_computed(tile_count, column, row, w))
        return;
    const size_t pixel = (size_t)row * w + column, at = pixel * 2 * c + first;
    const float16 features = load16(x + at, lanes), gates = load16(x + at + c, lanes);
    const float16 dL_dout = load16(grad_out + pixel * c + first, lanes);
    const float16 decay = exp(-fabs(gates)), open = sigmoid(gates, decay);
    // sigmoid' = sigmoid(x) sigmoid(-x); 1 - sigmoid(x) would cancel
    const float16 closed = sigmoid(-gates, decay);
    store16(dL_dout * open * exp(negative_part(features)), grad_x + at, lanes);
    store16(dL_dout * elu(features) * (open * closed), grad_x + at + c, lanes);
}
