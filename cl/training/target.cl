// The target of a rendering: a stored image, reduced by area and composited over white.
#include "common.h"

// One work-item per target pixel: reads its block of downscale x downscale stored pixels, writes
// the mean colour of those that exist, white if none does, and their mean alpha, 0 if none does.
// Straight alpha: colour over white = rgb * a + (1 - a).
kernel void target_forward(
    const int width,  // of the target, pixels
    const int height,
    const int downscale,  // stored pixels that a target pixel spans, each way
    const int left,       // stored column and row where the block of target pixel (0, 0) starts,
    const int top,        //   possibly outside of the image
    const int image_width,
    const int image_height,
    global const uchar4 *image,  // (image_height, image_width, 4) straight RGBA
    global float *target,        // (height, width, 3)
    global float *alpha)         // (height, width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int x0 = max(left + downscale * x, 0), x1 = min(left + downscale * (x + 1), image_width);
    const int y0 = max(top + downscale * y, 0), y1 = min(top + downscale * (y + 1), image_height);
    // of colours in units of 1 / 255^2; exact up to downscale = 16, where it reaches 2^24
    float4 sum = 0.0f;
    uint opaque = 0;
    for (int v = y0; v < y1; v++) {
        uint4 row = 0;
        for (int u = x0; u < x1; u++) {
            const uint4 c = convert_uint4(image[v * image_width + u]);
            row += c * c.w + 255 * (255 - c.w);
            opaque += c.w;
        }
        sum += convert_float4(row);
    }
    const int count = max(x1 - x0, 0) * max(y1 - y0, 0);
    const float4 mean = count > 0 ? sum / (65025.0f * count) : (float4)(1.0f);
    vstore3(mean.xyz, y * width + x, target);
    alpha[y * width + x] = count > 0 ? opaque / (255.0f * count) : 0.0f;
}
