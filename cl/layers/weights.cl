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
// Rows of `table`: first work-item; 0 for weights of an input gradient (blocks, K, K, co, 16), 1 for
// the transform G g G^T (winograd.h), 2 for that of an input gradient; taps (K * K); channels that
// the result is computed from, and of the result, the first of these among the input channels; input
// channels of the weights; where weights and vectors begin; 1 if they are halved.
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
    const int kind = row[1], taps = row[2], channels = row[3], ci = row[6];
    const int c = (item - row[0]) % channels, rest = (item - row[0]) / channels;
    const float scale = row[9] ? 0.5f : 1.0f;
    global const float *weight = weights + row[7];
    global float16 *out = laid_out + row[8];
    if (kind == 0) {
        const int tap = rest % taps, block = rest / taps;
        out[(block * taps + taps - 1 - tap) * channels + c] =
            across(weight, taps, tap, c, ci, row[5] + block * 16, row[4] - block * 16, scale);
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
        out[WEIGHT_AT(i, rest, row[4] / 16, channels) + c] = t[i];
#endif
}
