// Pixels that say nothing: the loss (loss.cl) neither sees them nor moves what they show.
#include "common.h"

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
