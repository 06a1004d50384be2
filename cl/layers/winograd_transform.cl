// Winograd's transform of the weights of a 3x3 convolution, G g G^T (winograd.h), to the layout
// that winograd.cl reads.
#include "layers/winograd.h"

// One work-item per (weights, 16 channels of the result, channel that it is computed from): reads 3
// x 3 weights, writes their values at all positions; for an input gradient those of the mirrored
// kernels with the roles of input and output channels exchanged. Rows of `table`: first work-item,
// channels, groups of 16 channels of the result, where weights and values begin, first input
// channel taken, input channels of the weights, 1 for an input gradient.
kernel void winograd_transform(
    const uint n,  // work-items
    const uint rows,
    global const int *table,      // (rows, 8)
    global const float *weights,  // (?) of all rows, each (blocks, 3, 3, ci, 16)
    global float16 *transformed)  // (...)
{
    const int item = get_global_id(0);
    if (item >= n) return;
    global const int *row = table;
    for (uint r = 1; r < rows && table[8 * r] <= item; r++)
        row += 8;
    const int channels = row[1], blocks = row[2], first = row[5], ci = row[6];
    const int c = (item - row[0]) % channels, block = (item - row[0]) / channels;
    global const float *weight = weights + row[3];
    float16 t[POSITIONS];
    UNROLLED_FOR (int i = 0; i < 9; i++) {
        global const float *tap =
            weight + ((c / 16 * 9 + 8 - i) * ci + first + block * 16) * 16 + c % 16;
        t[i / 3 * WINO_S + i % 3] =
            row[7] ? (float16)(tap[0], tap[16], tap[32], tap[48], tap[64], tap[80], tap[96],
                               tap[112], tap[128], tap[144], tap[160], tap[176], tap[192], tap[208],
                               tap[224], tap[240])
                   : vload16((block * 9 + i) * ci + c, weight);
    }
    transform_kernel_tile(t);
    UNROLLED_FOR (int i = 0; i < POSITIONS; i++)
        transformed[row[4] + WEIGHT_AT(i, block, blocks, channels) + c] = t[i];
}
