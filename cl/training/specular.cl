// Training data of the specular layer (layers/specular.h): pixels of all views, drawn in any order.
// They are stored as half, which halves their memory.
#include "layers/specular.h"

#define ROW (CHANNELS + 9)  // features, direction, place and residual of a pixel

// One work-item per chosen pixel: writes its features, its direction, its place and its residual,
// the target minus the image, over alpha.
kernel void specular_rows(
    const uint m,      // chosen pixels
    const uint first,  // row of the first one
    const uint width,  // of the image
    const uint target_width,
    const uint left,  // of the target's corner in the image
    const uint top,
    const float supersampling,          // camera pixels along a side of an image pixel
    const float extent,                 // world units of 1 in places
    global const uint *chosen,          // (m) pixels of the image
    global const float *camera,         // (21) camera.h
    global const float *transmittance,  // (HW) of the image
    global const float *features,       // (H, W, 16) of the image
    global const float *mean_range,     // (HW) of what the pixels show, raster/weights.cl
    global const float *image,          // (H, W, 3)
    global const float *target,         // (?, target_width, 3)
    global half *rows)                  // (ROWS, ROW)
{
    const uint i = get_global_id(0);
    if (i >= m) return;
    const uint pixel = chosen[i], x = pixel % width, y = pixel / width;
    const Camera cam = camera_load(camera);
    global half *row = rows + ROW * ((size_t)first + i);
    for (int c = 0; c < CHANNELS; c++)
        vstore_half(features[(size_t)CHANNELS * pixel + c], c, row);
    const float3 direction = direction_of(&cam, x, y, supersampling);
    vstore_half3(direction, 0, row + CHANNELS);
    const float3 place = place_of(&cam, direction, mean_range[pixel], extent);
    vstore_half3(place, 0, row + CHANNELS + 3);
    const float3 wanted = vload3((size_t)target_width * (y - top) + x - left, target);
    const float alpha = 1.0f - transmittance[pixel];
    vstore_half3((wanted - vload3(pixel, image)) / alpha, 0, row + CHANNELS + 6);
}

// One work-item per pixel of a batch: writes the layer's inputs, and the output that it should give.
kernel void specular_batch(
    const uint n,
    const float unit,          // of the residuals
    global const uint *drawn,  // (n) rows
    global const half *rows,   // (ROWS, ROW)
    global float *inputs,      // (?, ?, INPUTS) n in all
    global float *wanted)      // (?, ?, 3)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    global const half *row = rows + ROW * (size_t)drawn[i];
    global float *input = inputs + INPUTS * (size_t)i;
    for (int c = 0; c < CHANNELS; c++)
        input[c] = vload_half(c, row);
    float values[9];  // direction, place, residual
    for (int k = 0; k < 9; k++)
        values[k] = vload_half(CHANNELS + k, row);
    const float *direction = values, *place = values + 3;
    global float *encoded = input + CHANNELS;
    ENCODE(float, direction, OCTAVES, encoded)
    ENCODE(float, place, PLACE_OCTAVES, (encoded + DIRECTION_INPUTS))
    vstore3(0.5f + vload3(2, values) / unit, i, wanted);
}

// One work-item per value: writes the gradient of the mean square of image - wanted.
kernel void specular_gradient(
    const uint n,
    global const float *image,   // (H, W, 3)
    global const float *wanted,  // (H, W, 3)
    global float *gradient)      // (H, W, 3)
{
    const uint i = get_global_id(0);
    if (i < n) gradient[i] = 2.0f / n * (image[i] - wanted[i]);
}
