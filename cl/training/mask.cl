// The mask term of the loss: weight * mean of (a - m)^2 of the rendered alpha a = 1 - T and the
// image's alpha m. Where a < m it counts `shortfall` times, which rises from 0 to 1 in the
// course of a training: at first it would hold the points of the hull that lie in front of the
// surface. Nothing is learned of pixels that are ignored.
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
    global const float *target_alpha,   // (H, W) m, below 0 where it is ignored
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
        float m = -1.0f;
        if (inside && x >= left && x < left + w) m = target_alpha[(y - top) * w + x - left];
        const float difference = m < 0.0f ? 0.0f : 1.0f - transmittance[q] - m;
        const float weighted = difference < 0.0f ? shortfall * difference : difference;
        grad_alpha[q] = scale * weighted;
        sum += weighted * difference;
    }
    sum = group_sum(sum, shared);
    if (MEMBER == 0) row_term[y] = sum;
}

// One work-item per target pixel: where it is ignored, the target becomes what was rendered, of
// which the loss is 0, and its alpha -1.
kernel void ignore_target(
    const uint w,  // target
    const uint h,
    const uint pw,                   // width of the prediction
    const uint corner,               // first value of the prediction under the target
    global const uchar *ignored,     // (H, W) 1 where it is
    global const float *prediction,  // (PH, PW, 3)
    global float *target,            // (H, W, 3)
    global float *target_alpha)      // (H, W)
{
    const uint x = get_global_id(0), y = get_global_id(1), q = y * w + x;
    if (x >= w || y >= h || !ignored[q]) return;
    vstore3(vload3(x, prediction + corner + 3 * (size_t)pw * y), q, target);
    target_alpha[q] = -1.0f;
}

// One work-item per target pixel: where it is ignored, the gradient becomes 0, which the windows of
// its neighbours see.
kernel void ignore_gradient(
    const uint w,  // target
    const uint h,
    const uint pw,                  // width of the prediction
    const uint corner,              // first value of the prediction under the target
    global const uchar *ignored,    // (H, W) 1 where it is
    global float *grad_prediction)  // (PH, PW, 3)
{
    const uint x = get_global_id(0), y = get_global_id(1);
    if (x >= w || y >= h || !ignored[y * w + x]) return;
    vstore3((float3)(0.0f), x, grad_prediction + corner + 3 * (size_t)pw * y);
}
