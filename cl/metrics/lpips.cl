// LPIPS v0.1 (Zhang et al. 2018) around the layers of VGG16: the input's scaling and the distance
// of two feature maps, with their gradients.
#include "reduce.h"

// A fused a*s - b*t rounds one product only: the same image would differ from itself by 1e-15, and
// a from b unlike b from a.
#pragma OPENCL FP_CONTRACT OFF

// ImageNet's mean and deviation, moved from [0, 1] to [-1, 1]: the constants of LPIPS
#define SHIFT ((float3)(-0.030f, -0.088f, -0.188f))
#define SCALE ((float3)(0.458f, 0.448f, 0.450f))
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

// Length of a pixel's features.
ALWAYS_INLINE float length_of(global const float16 *features, const uint blocks) {
    float16 squares = 0.0f;
    for (uint k = 0; k < blocks; k++)
        squares += features[k] * features[k];
    return sqrt(sum16(squares));
}

// One work-item per pixel: reads its features in both images, writes the weighted squared distance
// of their directions.
kernel void lpips_distance(
    const uint n,                // pixels
    const uint c,                // channels, a multiple of 16
    global const float16 *a,     // (N, C)
    global const float16 *b,     // (N, C)
    global const float16 *head,  // (C)
    global float *distance)      // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const uint blocks = c / 16;
    a += (size_t)i * blocks;
    b += (size_t)i * blocks;
    const float scale_a = 1.0f / (length_of(a, blocks) + EPSILON);
    const float scale_b = 1.0f / (length_of(b, blocks) + EPSILON);

    float16 sum = 0.0f;
    for (uint k = 0; k < blocks; k++) {
        const float16 d = a[k] * scale_a - b[k] * scale_b;
        sum += head[k] * d * d;
    }
    distance[i] = sum16(sum);
}

// One work-item per pixel: reads its features in both images, writes the gradient of `weight` times
// their distance by a. It is 0 where a is: a is the output of a ReLU, grad_a the gradient of that
// ReLU's input.
kernel void lpips_distance_backward(
    const uint n,                // pixels
    const uint c,                // channels, a multiple of 16
    const float weight,          // of the distance of a pixel
    global const float16 *a,     // (N, C)
    global const float16 *b,     // (N, C)
    global const float16 *head,  // (C)
    global float16 *grad_a)      // (N, C)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const uint blocks = c / 16;
    a += (size_t)i * blocks;
    b += (size_t)i * blocks;
    grad_a += (size_t)i * blocks;
    const float length_a = length_of(a, blocks);
    const float scale_a = 1.0f / (length_a + EPSILON);
    const float scale_b = 1.0f / (length_of(b, blocks) + EPSILON);

    // The distance by the direction u = a * scale_a is 2 head d; what of it lies along u changes
    // nothing, because a change of length does not turn u.
    float16 product = 0.0f;
    for (uint k = 0; k < blocks; k++) {
        const float16 u = a[k] * scale_a;
        product += head[k] * (u - b[k] * scale_b) * u;
    }
    const float along = length_a > 0.0f ? sum16(product) / (length_a * scale_a) : 0.0f;
    for (uint k = 0; k < blocks; k++) {
        const float16 u = a[k] * scale_a;
        const float16 dL_du = head[k] * (u - b[k] * scale_b) - along * u;
        grad_a[k] = select((float16)0.0f, 2.0f * weight * scale_a * dL_du, a[k] > 0.0f);
    }
}
