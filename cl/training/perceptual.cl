// The perceptual term of the loss: weight * LPIPS, where LPIPS is the sum over the blocks of VGG16
// of the mean of their pixels' distances.
#include "reduce.h"
#include "vector.h"

// One work-item per row of a block's pixels: writes what the row gives to LPIPS.
kernel void perceptual_rows(
    const uint h,
    const uint w,
    const uint first,              // place of the block's first row among those of all blocks
    global const float *distance,  // (h, w)
    global float *row_term)        // (?)
{
    const uint y = get_global_id(0);
    if (y >= h) return;
    float16 sum = 0.0f;
    for (uint x = 0; x < w; x += 16)
        sum += load16(distance + (size_t)y * w + x, (int)(w - x));
    row_term[first + y] = sum16(sum) / ((float)h * w);
}

// One work-item: writes the sum of the rows, LPIPS, and ADDS it, weighted, to the loss.
kernel void perceptual_sum(
    const uint n,                  // rows of all blocks
    const float weight,            // of LPIPS
    global const float *row_term,  // (n)
    global float *distance,        // (1) LPIPS
    global float *terms)           // (4) the loss's; accumulates in the first
{
    if (get_global_id(0) > 0) return;
    float sum = 0.0f;
    for (uint i = 0; i < n; i++)
        sum += row_term[i];
    distance[0] = sum;
    terms[0] += weight * sum;
}
