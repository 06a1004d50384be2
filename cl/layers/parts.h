// The gradients of the weights and biases of all convolutions are sums of parts, each of another
// share of the image. A table has a row for each convolution, PartsRow of
// pp_cl/engine/layers/conv.py.
#ifndef PP_PARTS_H
#define PP_PARTS_H

#include "lanes.h"

#ifndef PARTS_ITEM
#define PARTS_ITEM 0     // first row of partial of all weights
#define PARTS_SUMS 1     // rows of a part and block: K * K * ci + 1, the last one the bias
#define PARTS_BLOCKS 2   // groups of 16 output channels
#define PARTS_PARTS 3    // parts
#define PARTS_PARTIAL 4  // where the parts begin, in vectors of 16, as the next two
#define PARTS_WEIGHT 5   // where the gradient of the weights begins
#define PARTS_BIAS 6     // where that of the biases begins
#define PARTS_HALVED 7   // 1: the sums are halved
#endif

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
    const int per_block = of[PARTS_SUMS], blocks = of[PARTS_BLOCKS], parts = of[PARTS_PARTS];
    const int row = (item - of[PARTS_ITEM]) % per_block,
              block = (item - of[PARTS_ITEM]) / per_block;
    Sum found;
    found.sum = 0.0f;
    for (int part = 0; part < parts; part++)
        found.sum += load_part(
            partial, of[PARTS_PARTIAL] + ((size_t)part * blocks + block) * per_block + row);
    if (of[PARTS_HALVED]) found.sum *= 0.5f;
    found.is_bias = row == per_block - 1;
    found.at =
        found.is_bias ? of[PARTS_BIAS] + block : of[PARTS_WEIGHT] + block * (per_block - 1) + row;
    return found;
}

#endif
