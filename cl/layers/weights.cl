// Weights as kernels read them, if not as they are, for all convolutions at once, of which a table
// has rows.
#include "lanes.h"
#include "layers/parts.h"

#ifndef WINOGRAD
#define WINOGRAD 1  // 0: no weights are transformed, as on GPUs, where that would spill
#endif
#if WINOGRAD
#include "layers/winograd.h"
#endif

// Columns of a row of the table, WeightsRow of pp_cl/engine/layers/choice.py.
#ifndef ROW_ITEM
#define ROW_ITEM 0  // first work-item
// 0: weights of an input gradient (blocks, K, K, co, 16), 1: the transform G g G^T (winograd.h), 2:
// that of an input gradient
#define ROW_KIND 1
#define ROW_TAPS 2    // K * K
#define ROW_READ 3    // channels that the result is computed from
#define ROW_MADE 4    // channels of the result
#define ROW_FIRST 5   // the first of these among the input channels
#define ROW_CI 6      // input channels of the weights
#define ROW_WEIGHT 7  // where the weights begin
#define ROW_OUT 8     // where the result's vectors begin
#define ROW_HALVED 9  // 1: the result is halved
#endif

// `scale` times the weights of `count` input channels from `first` on, at most 16, for a tap and the
// output channel o; 0 beyond.
static inline float16 across(
    global const float *weight,  // (blocks, taps, ci, 16)
    const int taps,
    const int tap,
    const int o,
    const int ci,
    const int first,
    const int count,
    const float scale) {
    global const float *at = weight + ((o / 16 * taps + tap) * ci + first) * 16 + o % 16;
    float lane[16];
    for (int i = 0; i < 16; i++)
        lane[i] = i < count ? scale * at[16 * i] : 0.0f;
    return vload16(0, lane);
}

// One work-item per vector of 16 channels of the result and channel that it is computed from; one
// for all taps where weights are transformed. For an input gradient kernels are mirrored, input and
// output channels exchange their roles, and what is halved behind the convolution is halved here.
kernel void lay_out_weights(
    const uint n,  // work-items
    const uint rows,
    global const int *table,      // (rows, 10)
    global const float *weights,  // (?) of all rows, each (blocks, K, K, ci, 16)
    global float16 *laid_out)     // (...)
{
    const int item = get_global_id(0);
    if (item >= n) return;
    global const int *row = row_of(table, 10, rows, item);
    const int kind = row[ROW_KIND], taps = row[ROW_TAPS], channels = row[ROW_READ],
              ci = row[ROW_CI];
    const int c = (item - row[ROW_ITEM]) % channels, rest = (item - row[ROW_ITEM]) / channels;
    const float scale = row[ROW_HALVED] ? 0.5f : 1.0f;
    global const float *weight = weights + row[ROW_WEIGHT];
    global float16 *out = laid_out + row[ROW_OUT];
    if (kind == 0) {
        const int tap = rest % taps, block = rest / taps;
        out[(block * taps + taps - 1 - tap) * channels + c] = across(
            weight, taps, tap, c, ci, row[ROW_FIRST] + block * 16, row[ROW_MADE] - block * 16,
            scale);
        return;
    }
#if WINOGRAD
    float16 t[POSITIONS];
    UNROLLED_FOR (int i = 0; i < 9; i++)
        t[i / 3 * WINO_S + i % 3] = kind == 2
                                        ? across(weight, 9, 8 - i, c, ci, rest * 16, 16, scale)
                                        : vload16((rest * 9 + i) * ci + c, weight);
    transform_kernel_tile(t);
    UNROLLED_FOR (int i = 0; i < POSITIONS; i++)
        out[WEIGHT_AT(i, rest, row[ROW_MADE] / 16, channels) + c] = t[i];
#endif
}
