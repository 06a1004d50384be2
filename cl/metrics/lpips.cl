// LPIPS v0.1 (Zhang et al. 2018) around the layers of VGG16: the input's scaling and the distance
// of two feature maps, with their gradients.
//
// A pixel's C features are rows of 16. Of the kernels that read them, GROUP = ROW_PARTS work-items
// share a pixel, each with its part of every row; on CPUs that is one.
#include "group.h"
#include "lanes.h"

// A fused a*s - b*t rounds one product only: the same image would differ from itself by 1e-15, and
// a from b unlike b from a.
#pragma OPENCL FP_CONTRACT OFF

// ImageNet's mean and deviation, moved from [0, 1] to [-1, 1]: the constants of LPIPS
#define SHIFT ((float3)(-0.030f, -0.088f, -0.188f))
#define SCALE ((float3)(0.458f, 0.448f, 0.450f))
#ifndef ITEMS
#define ITEMS 64  // the most of a work-group
#endif
#define EPSILON 1e-10f  // LPIPS's own guard for pixels without features

// One work-item per pixel of x: reads its colour in [0, 1], writes it scaled as the network was
// trained.
kernel void lpips_input(
    const uint h,
    const uint w,
    const uint image_width,
    const uint corner,          // first value of the image that is read
    global const float *image,  // (?, image_width, 3)
    global float *x)            // (h, w, 3)
{
    const uint column = get_global_id(0), row = get_global_id(1);
    if (column >= w || row >= h) return;
    const float3 colour = vload3((size_t)row * image_width + column, image + corner);
    vstore3((2.0f * colour - 1.0f - SHIFT) / SCALE, (size_t)row * w + column, x);
}

// One work-item per pixel of x: ADDS the gradient of its colour to grad_image.
kernel void lpips_input_backward(
    const uint h,
    const uint w,
    const uint image_width,
    const uint corner,           // first value of the image that was read
    global const float *grad_x,  // (h, w, 3)
    global float *grad_image)    // (?, image_width, 3) accumulates
{
    const uint column = get_global_id(0), row = get_global_id(1);
    if (column >= w || row >= h) return;
    const float3 dL_dx = vload3((size_t)row * w + column, grad_x);
    const size_t pixel = (size_t)row * image_width + column;
    const float3 others = vload3(pixel, grad_image + corner);
    vstore3(others + 2.0f / SCALE * dL_dx, pixel, grad_image + corner);
}

// This work-item's part of the squared length of a pixel's features.
ALWAYS_INLINE float squares_of(global const float16 *features, const uint rows) {
    floats squares = 0.0f;
    for (uint k = 0; k < rows; k++)
        squares += load_part(features, k) * load_part(features, k);
    return SUM_LANES(squares);
}

// GROUP work-items per pixel: read its features in both images, write the weighted squared distance
// of their directions.
kernel void lpips_distance(
    const uint n,                // pixels
    const uint c,                // channels, a multiple of 16
    global const float16 *a,     // (N, C)
    global const float16 *b,     // (N, C)
    global const float16 *head,  // (C)
    global float *distance)      // (N)
{
    SHARED(float, shared, ITEMS);
    const uint i = min(GROUP_ID, n - 1), rows = c / CHANNELS;
    a += (size_t)i * rows;
    b += (size_t)i * rows;
    const float scale_a = 1.0f / (sqrt(group_sum(squares_of(a, rows), shared)) + EPSILON);
    const float scale_b = 1.0f / (sqrt(group_sum(squares_of(b, rows), shared)) + EPSILON);

    floats sum = 0.0f;
    for (uint k = 0; k < rows; k++) {
        const floats d = load_part(a, k) * scale_a - load_part(b, k) * scale_b;
        sum += load_part(head, k) * d * d;
    }
    const float of_pixel = group_sum(SUM_LANES(sum), shared);
    if (GROUP_ID < n && MEMBER == 0) distance[i] = of_pixel;
}

// GROUP work-items per pixel: read its features in both images, write the gradient of `weight`
// times their distance by a. It is 0 where a is: a is the output of a ReLU, grad_a the gradient of
// that ReLU's input.
kernel void lpips_distance_backward(
    const uint n,                // pixels
    const uint c,                // channels, a multiple of 16
    const float weight,          // of the distance of a pixel
    global const float16 *a,     // (N, C)
    global const float16 *b,     // (N, C)
    global const float16 *head,  // (C)
    global float16 *grad_a)      // (N, C)
{
    SHARED(float, shared, ITEMS);
    const uint i = min(GROUP_ID, n - 1), rows = c / CHANNELS;
    a += (size_t)i * rows;
    b += (size_t)i * rows;
    grad_a += (size_t)i * rows;
    const float length_a = sqrt(group_sum(squares_of(a, rows), shared));
    const float scale_a = 1.0f / (length_a + EPSILON);
    const float scale_b = 1.0f / (sqrt(group_sum(squares_of(b, rows), shared)) + EPSILON);

    // The distance by the direction u = a * scale_a is 2 head d; what of it lies along u changes
    // nothing, because a change of length does not turn u.
    floats product = 0.0f;
    for (uint k = 0; k < rows; k++) {
        const floats u = load_part(a, k) * scale_a;
        product += load_part(head, k) * (u - load_part(b, k) * scale_b) * u;
    }
    const float of_pixel = group_sum(SUM_LANES(product), shared);
    const float along = length_a > 0.0f ? of_pixel / (length_a * scale_a) : 0.0f;
    if (GROUP_ID >= n) return;
    for (uint k = 0; k < rows; k++) {
        const floats value = load_part(a, k), u = value * scale_a;
        const floats dL_du = load_part(head, k) * (u - load_part(b, k) * scale_b) - along * u;
        store_part(select((floats)0.0f, 2.0f * weight * scale_a * dL_du, value > 0.0f), grad_a, k);
    }
}
