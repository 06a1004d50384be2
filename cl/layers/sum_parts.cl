// The sums of the parts of the gradients of weights and biases, for all convolutions at once.
#include "lanes.h"
#include "layers/parts.h"

// One work-item per part of a row of parts.h: writes LANES values of a gradient.
kernel void sum_parts(
    const uint n,  // rows of partial, of one part of all weights
    const uint rows,
    global const int *table,        // (rows, 8) parts.h
    global const float16 *partial,  // (...) as there
    global float16 *grad_weights,   // (...)
    global float16 *grad_biases)    // (...)
{
    const int item = get_global_id(0) / ROW_PARTS;
    if (item >= n) return;
    const Sum found = sum_of(table, rows, partial, item);
    store_part(found.sum, found.is_bias ? grad_biases : grad_weights, found.at);
}
