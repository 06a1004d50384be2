// From the last layer's output to the image: image = 0.5 + 0.5 * output, and with a residual
// connection around the whole network share * (feature - background) of its first three features.
#include "common.h"

// One work-item per pixel: reads its output and, with residual, its features; writes its colours.
kernel void output_forward(
    const uint n,         // pixels
    const uint channels,  // of the features
    const int residual,
    const float share,
    global const float *features,  // (H, W, channels) not read without residual
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

// One work-item per colour: reads its gradient, writes that of the last layer's output.
kernel void output_backward(
    const uint n,
    global const float *grad_image,  // (H, W, 3)
    global float *grad_out)          // (H, W, 3)
{
    const size_t i = get_global_id(0);
    if (i >= n) return;
    grad_out[i] = 0.5f * grad_image[i];
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

// Without a network: the image is the mean of the first three features of scale x scale pixels.

// One work-item per pixel of the image: reads the features of its pixels, writes its colours.
kernel void mean_forward(
    const uint height,
    const uint width,  // of the image
    const uint scale,
    const uint channels,
    global const float *features,  // (height*scale, width*scale, channels)
    global float *image)           // (height, width, 3)
{
    const uint x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    for (uint c = 0; c < 3; c++) {
        float sum = 0.0f;
        for (uint j = 0; j < scale * scale; j++) {
            const size_t row = y * scale + j / scale, column = x * scale + j % scale;
            sum += features[(row * width * scale + column) * channels + c];
        }
        image[3 * ((size_t)y * width + x) + c] = sum / (scale * scale);
    }
}

// One work-item per pixel of the features: reads the gradient of its pixel of the image, writes that
// of its features.
kernel void mean_backward(
    const uint height,
    const uint width,  // of the image
    const uint scale,
    const uint channels,
    global const float *grad_image,  // (height, width, 3)
    global float *grad_features)     // (height*scale, width*scale, channels)
{
    const uint x = get_global_id(0), y = get_global_id(1);
    if (x >= width * scale || y >= height * scale) return;
    const size_t from = 3 * ((size_t)(y / scale) * width + x / scale);
    const size_t to = ((size_t)y * width * scale + x) * channels;
    for (uint c = 0; c < channels; c++)
        grad_features[to + c] = c < 3 ? grad_image[from + c] / (scale * scale) : 0.0f;
}
