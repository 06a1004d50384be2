// LPIPS v0.1 (Zhang et al. 2018) around the layers of VGG16: the input's scaling and the distance
// of two feature maps.
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

// One work-item per pixel: reads its colour in [0, 1], writes it scaled as the network was trained.
kernel void lpips_input(
    const uint n,               // pixels
    global const float *image,  // (?, ?, 3)
    global float *x)            // (?, ?, 3)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    vstore3((2.0f * vload3(i, image) - 1.0f - SHIFT) / SCALE, i, x);
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
