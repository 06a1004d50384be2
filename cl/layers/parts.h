// The gradients of the weights and biases of all convolutions are sums of parts, each of another
// share of the image. A table has a row for each convolution: first row of partial of all weights;
// rows of one part and group of 16 output channels (K * K * ci + 1, the last one the bias); such
// groups; parts; where the parts, the gradient of the weights and that of the biases begin, in
// vectors of 16; 1 if the sums are halved.
#ifndef PP_PARTS_H
#define PP_PARTS_H

#include "lanes.h"

// The row of the table whose items are from its first number on. length: of a row.
static inline global const int *
row_of(global const int *table, const int length, const uint rows, const int item) {
    global const int *row = table;
    for (uint r = 1; r < rows && table[length * r] <= item; r++)
        row += length;
    return row;
}

typedef struct {
    floats sum;
    size_t at;  // the vector of 16 of which it is a part, among the weights or the biases
    bool is_bias;
} Sum;

// LANES values of a gradient: the parts added up in order. item: row of partial, of one part of all
// weights.
ALWAYS_INLINE Sum
sum_of(global const int *table, const uint rows, global const float16 *partial, const int item) {
    global const int *of = row_of(table, 8, rows, item);
    const int per_block = of[1], blocks = of[2], parts = of[3];
    const int row = (item - of[0]) % per_block, block = (item - of[0]) / per_block;
    Sum found;
    found.sum = 0.0f;
    for (int part = 0; part < parts; part++)
        found.sum += load_part(partial, of[4] + ((size_t)part * blocks + block) * per_block + row);
    if (of[7]) found.sum *= 0.5f;
    found.is_bias = row == per_block - 1;
    found.at = found.is_bias ? of[6] + block : of[5] + block * (per_block - 1) + row;
    return found;
}

#endif
