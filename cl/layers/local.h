// Four neighbouring channels as one vector, and how the convolutions through local memory cut a
// feature map (conv_local.cl, conv_local_backward_weights.cl).
#ifndef PP_LOCAL_H
#define PP_LOCAL_H

#include "gpu/vector.h"
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
#define SPAN (MAP_TILE + KERNEL_SIZE - 1)  // side of what a tile of outputs sees

// The 4 values at p, of which `count` exist: all where the channels are multiples of 4.
#if ALIGNED
#define load_quad(p, count) (*(global const float4 *)(p))
#define store_quad(value, p, count) (*(global float4 *)(p) = (value))
#else
#define load_quad load4
#define store_quad store4
#endif

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
    return load_quad(image + ((size_t)y * width + x) * channels + c, channels - c);
}

#endif
