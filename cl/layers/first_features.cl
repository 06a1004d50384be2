// Without a network: the image is the first three features.
#include "common.h"

// One work-item per pixel: reads its features, writes its colours.
kernel void first_features_forward(
    const uint n,                  // pixels
    const uint channels,           // of the features
    global const float *features,  // (H, W, channels)
    global float *image)           // (H, W, 3)
{
    const size_t i = get_global_id(0);
    if (i >= n) return;
    for (size_t c = 0; c < 3; c++)
        image[3 * i + c] = features[channels * i + c];
}

// One work-item per pixel: reads the gradient of its colours, writes that of its features.
kernel void first_features_backward(
    const uint n,                    // pixels
    const uint channels,             // of the features
    global const float *grad_image,  // (H, W, 3)
    global float *grad_features)     // (H, W, channels)
{
    const size_t i = get_global_id(0);
    if (i >= n) return;
    for (size_t c = 0; c < channels; c++)
        grad_features[channels * i + c] = c < 3 ? grad_image[3 * i + c] : 0.0f;
}
