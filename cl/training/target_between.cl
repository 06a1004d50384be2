// The target of a rendering between the pixels of a stored image that is not reduced, composited over
// white.
#include "common.h"

// Weights of the five pixels around a place that lies t in [-1/2, 1/2] behind the middle one: of
// Lagrange's polynomial through them, which lets fine detail pass where a shorter one blurs it.
static inline void lagrange(const float t, float weights[5]) {
    const float a = t * t - 1.0f, b = t * t - 4.0f;
    weights[0] = t * a * (t - 2.0f) / 24.0f;
    weights[1] = -t * b * (t - 1.0f) / 6.0f;
    weights[2] = a * b / 4.0f;
    weights[3] = -t * b * (t + 1.0f) / 6.0f;
    weights[4] = t * a * (t + 2.0f) / 24.0f;
}

// One work-item per target pixel: reads the 5 x 5 pixels around it, those at the image's edge for
// what lies beyond, writes its colour and its alpha.
kernel void target_between(
    const int width,
    const int height,
    const float across,  // pixels by which the target lies further right, at most half a one
    const float down,
    const int left,  // image's column and row of target pixel (0, 0)
    const int top,
    const int image_width,
    const int image_height,
    global const uchar4 *image,  // (image_height, image_width, 4) straight RGBA
    global float *target,        // (height, width, 3)
    global float *alpha)         // (height, width)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const int u = left + x, v = top + y;
    const bool outside = u < 0 || u >= image_width || v < 0 || v >= image_height;
    float columns[5], rows[5];
    lagrange(across, columns);
    lagrange(down, rows);
    float4 sum = 0.0f;
    for (int j = 0; j < 5; j++) {
        global const uchar4 *line = image + clamp(v + j - 2, 0, image_height - 1) * image_width;
        float4 row = 0.0f;
        for (int i = 0; i < 5; i++) {
            const float4 c = convert_float4(line[clamp(u + i - 2, 0, image_width - 1)]) / 255.0f;
            // what differs from white: where nothing does, the target is exactly 1 (tiles_find)
            row += columns[i] * (float4)((c.xyz - 1.0f) * c.w, c.w);
        }
        sum += rows[j] * row;
    }
    sum = clamp(sum + (float4)(1.0f, 1.0f, 1.0f, 0.0f), 0.0f, 1.0f);  // overshoots beside an edge
    vstore3(outside ? (float3)(1.0f) : sum.xyz, y * width + x, target);
    alpha[y * width + x] = outside ? 0.0f : sum.w;
}
