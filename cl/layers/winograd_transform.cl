// Winograd's transform of the weights of a 3x3 convolution, G g G^T (winograd.h), to the layout
// that winograd.cl reads.
//
// vec_type_hint: the vectors are written out; Intel's compiler would merge work-items into wider
// ones.
#include "layers/winograd.h"

// Three rows of three weights in t -> their values at all positions, of one input channel and 16
// output channels.
ALWAYS_INLINE void store_kernel(
    float16 *t,
    global float16 *transformed,
    const int channel,
    const int channels,
    const int block,
    const int blocks) {
    transform_kernel_tile(t);
#pragma unroll
    for (int i = 0; i < POSITIONS; i++)
        transformed[WEIGHT_AT(i, block, blocks, channels) + channel] = t[i];
}

// One work-item per (input channel, 16 output channels): reads 3 x 3 weights, writes their values
// at all positions.
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
