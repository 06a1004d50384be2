// Winograd's transform of the weights of a 3x3 convolution, G g G^T (winograd.h), to the layout
// that winograd.cl reads.
//
// With HALF, an output channel's weights are divided by its unit before they are transformed: a
// power of two, which costs no bit and takes weights of any size into half's range. The largest
// weight comes to lie from 2^13 to 2^14, what a transform makes of it (at most 2.25 times as much)
// below half's largest number 65504; what is larger than 2^-27 of the largest keeps all of half's
// 11 bits.
//
// vec_type_hint: the vectors are written out; Intel's compiler would merge work-items into wider
// ones.
#include "layers/winograd.h"
#include "reduce.h"

#define EXPONENT 23  // position of a float's exponent, biased by 127
#define LARGEST 13   // exponent of the largest weight in units

// The unit of 16 channels, given the bits of their largest weights without sign. None is below
// 2^-126, so that its inverse is a float; a weight that is Inf or NaN stays so in any unit.
ALWAYS_INLINE float16 unit_of(const int16 largest) {
    return as_float16((max(largest >> EXPONENT, (int16)(LARGEST + 1)) - LARGEST) << EXPONENT);
}

// One work-item per 16 output channels: reads all their weights and writes their units.
kernel __attribute__((vec_type_hint(float16))) void winograd_transform_units(
    const int ci,
    const int blocks,
    global const float16 *weight,  // (blocks, 3, 3, ci, 16)
    global float16 *transformed)   // (...)
{
    const int block = get_global_id(0);
    if (block >= blocks) return;
    int16 largest = 0;
    for (int i = 0; i < 9 * ci; i++)
        largest = max(largest, as_int16(weight[(size_t)block * 9 * ci + i]) & 0x7fffffff);
    transformed[block] = unit_of(largest);
}

// One work-item per input channel c: the same for the flipped weights, whose output channels are
// the input channels from `first` on.
kernel __attribute__((vec_type_hint(float16))) void winograd_transform_flipped_units(
    const int co,
    const int blocks,              // of input channels taken
    const int first,               // input channel
    const int ci,                  // channels of weight
    global const float16 *weight,  // (?, 3, 3, ci, 16)
    global float *transformed)     // (...)
{
    const int c = get_global_id(0);
    if (c >= blocks * 16) return;
    int16 all = 0;
    for (int i = 0; i < co / 16 * 9; i++)
        all = max(all, as_int16(weight[(size_t)i * ci + first + c]) & 0x7fffffff);
    transformed[c] = unit_of((int16)(max_int16(all))).x;
}

// Three rows of three weights in t -> their values at all positions, of one input channel and 16
// output channels.
ALWAYS_INLINE void store_kernel(
    float16 *t,
    global float16 *transformed,
    const int channel,
    const int channels,
    const int block,
    const int blocks) {
#if HALF
    // 1 / unit
    const float16 inverse = as_float16((2 * 127 << EXPONENT) - as_int16(transformed[block]));
#pragma unroll
    for (int i = 0; i < 9; i++)
        t[i / 3 * WINO_S + i % 3] *= inverse;
#endif
    transform_kernel_tile(t);
#pragma unroll
    for (int i = 0; i < POSITIONS; i++)
        STORE_WEIGHT(t[i], transformed, WEIGHT_AT(i, block, blocks, channels) + channel);
}

// One work-item per (input channel, 16 output channels): reads 3 x 3 weights (and, with HALF, their
// units), writes their values at all positions.
kernel __attribute__((vec_type_hint(float16))) void winograd_transform_weights(
    const int ci,
    const int blocks,
    global const float16 *weight,  // (blocks, 3, 3, ci, 16)
    global float16 *transformed)   // (...)
{
    const int c = get_global_id(0), block = get_global_id(1);
    if (c >= ci || block >= blocks) return;
    float16 t[POSITIONS];
#pragma unroll
    for (int i = 0; i < 9; i++)
        t[i / 3 * WINO_S + i % 3] = weight[(block * 9 + i) * ci + c];
    store_kernel(t, transformed, c, ci, block, blocks);
}

// One work-item per (output channel, 16 input channels from `first` on): the same for the mirrored
// kernels with the roles of input and output channels exchanged, which the input gradient is made
// with.
kernel __attribute__((vec_type_hint(float16))) void winograd_transform_flipped_weights(
    const int co,
    const int blocks,             // of input channels taken
    const int first,              // input channel
    const int ci,                 // channels of weight
    global const float *weight,   // (?, 3, 3, ci, 16)
    global float16 *transformed)  // (...)
{
    const int o = get_global_id(0), block = get_global_id(1);
    if (o >= co || block >= blocks) return;
    float16 t[POSITIONS];
#pragma unroll
    for (int i = 0; i < 9; i++) {
        global const float *tap =
            weight + ((o / 16 * 9 + 8 - i) * ci + first + block * 16) * 16 + o % 16;
        t[i / 3 * WINO_S + i % 3] = (float16)(tap[0], tap[16], tap[32], tap[48], tap[64], tap[80],
                                              tap[96], tap[112], tap[128], tap[144], tap[160],
                                              tap[176], tap[192], tap[208], tap[224], tap[240]);
    }
    store_kernel(t, transformed, o, co, block, blocks);
}
