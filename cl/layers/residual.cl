// The first three features beside the network: image += share * (feature - background). With an
// image of 0.5 + 0.5 * output this is a residual connection around the whole network.
#include "common.h"

#define BACKGROUND 1.0f  // of every feature, as in raster/blend.cl

// One work-item per pixel: reads its features, adds to its colours.
kernel void residual_forward(
    const uint n,         // pixels
    const uint channels,  // of the features
    const float share,
    global const float *features,  // (...) N rows of CHANNELS
    global float *image)           // (...) N rows of 3
{
    const size_t i = get_global_id(0);
    if (i >= n) return;
    for (size_t c = 0; c < 3; c++)
        image[3 * i + c] += share * (features[channels * i + c] - BACKGROUND);
}

// One work-item per pixel: reads the gradient of its colours, adds to that of its features.
kernel void residual_backward(
    const uint n,         // pixels
    const uint channels,  // of the features
    const float share,
    global const float *grad_image,  // (...) N rows of 3
    global float *grad_features)     // (...) N rows of CHANNELS
{
    const size_t i = get_global_id(0);
    if (i >= n) return;
    for (size_t c = 0; c < 3; c++)
        grad_features[channels * i + c] += share * grad_image[3 * i + c];
}
