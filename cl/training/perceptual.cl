// The perceptual term of the loss: weight * LPIPS, where LPIPS is the sum over the blocks of VGG16
// of the mean of their pixels' distances (metrics/lpips.cl computes these and their gradients).
#include "group.h"
#include "lanes.h"

// GROUP work-items per row of a block's pixels: write what the row gives to LPIPS.
kernel void perceptual_rows(
    const uint h,
    const uint w,
    const uint first,              // place of the block's first row among those of all blocks
    global const float *distance,  // (h, w)
    global float *row_term)        // (?)
{
    SHARED(float, shared, GROUP);
    const uint y = GROUP_ID;
    if (y >= h) return;
    floats sum = 0.0f;
    for (uint x = LANES * MEMBER; x < w; x += LANES * GROUP)
        sum += load_lanes(distance + (size_t)y * w + x, (int)(w - x));
    const float of_row = group_sum(SUM_LANES(sum), shared);
    if (MEMBER == 0) row_term[first + y] = of_row / ((float)h * w);
}
