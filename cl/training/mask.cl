// The mask term of the loss: weight * mean max(a - m, 0)^2 of the rendered alpha a = 1 - T and the
// photograph's alpha m. Only what exceeds the mask counts: the points in front of the hull fill it
// anyway, and would be held there.
#include "common.h"

// One work-item per row of the padded image: writes dL/da, 0 outside of the target, and the sum of
// the row's squares.
kernel void mask_gradient(
    const uint ph,  // padded image
    const uint pw,
    const uint h,  // target
    const uint w,
    const uint left,  // of the target in the padded image
    const uint top,
    const float weight,
    global const float *transmittance,  // (PHW) T
    global const float *target_alpha,   // (H, W) m
    global float *grad_alpha,           // (PHW)
    global float *row_term)             // (PH)
{
    const uint y = get_global_id(0);
    if (y >= ph) return;
    const float scale = 2.0f * weight / ((float)h * w);
    const bool inside = y >= top && y < top + h;
    float sum = 0.0f;
    for (uint x = 0; x < pw; x++) {
        const uint q = y * pw + x;
        float difference = 0.0f;
        if (inside && x >= left && x < left + w)
            difference =
                fmax(1.0f - transmittance[q] - target_alpha[(y - top) * w + x - left], 0.0f);
        grad_alpha[q] = scale * difference;
        sum += difference * difference;
    }
    row_term[y] = sum;
}

// One work-item: writes the mean of the squares, and ADDS it, weighted, to the loss.
kernel void mask_sum(
    const uint ph,      // rows of the padded image
    const uint pixels,  // of the target
    const float weight,
    global const float *row_term,  // (PH)
    global float *mean,            // (1)
    global float *terms)           // (4) the loss's; accumulates in the first
{
    if (get_global_id(0) > 0) return;
    float sum = 0.0f;
    for (uint y = 0; y < ph; y++)
        sum += row_term[y];
    mean[0] = sum / pixels;
    terms[0] += weight * mean[0];
}
