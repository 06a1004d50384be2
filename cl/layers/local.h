// Four neighbouring channels as one vector, and how the convolutions through local memory cut a
// feature map (conv_local.cl, conv_local_backward_weights.cl).
#ifndef PP_LOCAL_H
#define PP_LOCAL_H

#include "layers/tiles.h"

#ifndef KERNEL_SIZE
#define KERNEL_SIZE 3  // side of the kernel: 1 or 3
#endif
#ifndef ALIGNED
#define ALIGNED 0  // 1: all numbers of channels are multiples of 4
#endif
#ifndef QUADS
#define QUADS 4  // groups of 4 output channels of a work-group: 4, 8 or 16
#endif
#define TAPS (KERNEL_SIZE * KERNEL_SIZE)
#define PAD (KERNEL_SIZE / 2)
#define SPAN (SIDE + KERNEL_SIZE - 1)  // side of what a tile of outputs sees

// The 4 values at p, of which `count` exist; the others read as 0.
static inline float4 load4(global const float *p, const int count) {
#if ALIGNED
    return *(global const float4 *)p;
#else
    float4 few = 0.0f;
    few.x = p[0];
    few.y = count > 1 ? p[1] : 0.0f;
    few.z = count > 2 ? p[2] : 0.0f;
    few.w = count > 3 ? p[3] : 0.0f;
    return few;
#endif
}

// Write the first `count` of 4 values to p.
static inline void store4(const float4 value, global float *p, const int count) {
#if ALIGNED
    *(global float4 *)p = value;
#else
    p[0] = value.x;
    if (count > 1) p[1] = value.y;
    if (count > 2) p[2] = value.z;
    if (count > 3) p[3] = value.w;
#endif
}

// 4 channels, of which `count` exist, of a pixel from `c` on; 0 outside of the image.
static inline float4 pixel4(
    global const float *image,
    const int x,
    const int y,
    const int c,
    const int channels,
    const int height,
    const int width) {
    if (x < 0 || x >= width || y < 0 || y >= height || c >= channels) return (float4)(0.0f);
    return load4(image + ((size_t)y * width + x) * channels + c, channels - c);
}

#endif
