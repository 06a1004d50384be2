// From the last layer's output to the image: image = 0.5 + 0.5 * output, and with a residual
// connection around the whole network share * (feature - background) of its first three features.
#include "common.h"

// One work-item per pixel: reads its output and, with residual, its features; writes its colours.
kernel void output_forward(
    const uint n,         // pixels
    const uint channels,  // of the features
    const int residual,
    const float share,
    global const float *features,  // (H, W, channels) NULL without residual
    global float *image)           // (H, W, 3) the output, overwritten by the colours
{
    const size_t i = get_global_id(0);
    if (i >= n) return;
    for (size_t c = 0; c < 3; c++) {
        float colour = 0.5f * image[3 * i + c] + 0.5f;
        if (residual) colour += share * (features[channels * i + c] - BACKGROUND);
        image[3 * i + c] = colour;
    }
}

// One work-item per pixel: reads the gradient of its colours, adds to that of its features what
// passes around the network.
kernel void residual_backward(
    const uint n,         // pixels
    const uint channels,  // of the features
    const float share,
    global const float *grad_image,  // (H, W, 3)
    global float *grad_features)     // (H, W, channels)
{
    const size_t i = get_global_id(0);
    if (i >= n) return;
    for (size_t c = 0; c < 3; c++)
        grad_features[channels * i + c] += share * grad_image[3 * i + c];
}
