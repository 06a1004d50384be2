// The mask term of the loss: weight * mean of (a - m)^2 of the rendered alpha a = 1 - T and the
// photograph's alpha m. Where a < m it counts `shortfall` times, which rises from 0 to 1 in the
// course of a training: at first it would hold the points of the hull that lie in front of the
// surface.
#include "group.h"

// GROUP work-items per row of the padded image: write dL/da, 0 outside of the target, and the sum
// of the row's weighted squares.
kernel void mask_gradient(
    const uint ph,  // padded image
    const uint pw,
    const uint h,  // target
    const uint w,
    const uint left,  // of the target in the padded image
    const uint top,
    const float weight,
    const float shortfall,
    global const float *transmittance,  // (PHW) T
    global const float *target_alpha,   // (H, W) m
    global float *grad_alpha,           // (PHW)
    global float *row_term)             // (PH)
{
    SHARED(float, shared, GROUP);
    const uint y = GROUP_ID;
    if (y >= ph) return;
    const float scale = 2.0f * weight / ((float)h * w);
    const bool inside = y >= top && y < top + h;
    float sum = 0.0f;
    for (uint x = MEMBER; x < pw; x += GROUP) {
        const uint q = y * pw + x;
        float difference = 0.0f;
        if (inside && x >= left && x < left + w)
            difference = 1.0f - transmittance[q] - target_alpha[(y - top) * w + x - left];
        const float weighted = difference < 0.0f ? shortfall * difference : difference;
        grad_alpha[q] = scale * weighted;
        sum += weighted * difference;
    }
    sum = group_sum(sum, shared);
    if (MEMBER == 0) row_term[y] = sum;
}
