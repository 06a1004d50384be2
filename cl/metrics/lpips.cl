// LPIPS v0.1 (Zhang et al. 2018) around the layers of VGG16: the input's scaling and the distance
// of two feature maps.
#include "reduce.h"

// A fused a*s - b*t rounds one product only: the same image would differ from itself by 1e-15, and
// a from b unlike b from a.
#pragma OPENCL FP_CONTRACT OFF

// One work-item per pixel: reads its colour in [0, 1], writes it scaled as the network was trained.
kernel void lpips_input(
    const uint n,               // pixels
    global const float *image,  // (N, 3)
    global float *x)            // (N, 3)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    // ImageNet's mean and deviation, moved from [0, 1] to [-1, 1]: the constants of LPIPS
    const float3 shift = (float3)(-0.030f, -0.088f, -0.188f);
    const float3 scale = (float3)(0.458f, 0.448f, 0.450f);
    vstore3((2.0f * vload3(i, image) - 1.0f - shift) / scale, i, x);
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

    float16 aa = 0.0f, bb = 0.0f;
    for (uint k = 0; k < blocks; k++) {
        aa += a[k] * a[k];
        bb += b[k] * b[k];
    }
    // 1e-10: LPIPS's own guard for pixels without features
    const float scale_a = 1.0f / (sqrt(sum16(aa)) + 1e-10f);
    const float scale_b = 1.0f / (sqrt(sum16(bb)) + 1e-10f);

    float16 sum = 0.0f;
    for (uint k = 0; k < blocks; k++) {
        const float16 d = a[k] * scale_a - b[k] * scale_b;
        sum += head[k] * d * d;
    }
    distance[i] = sum16(sum);
}
