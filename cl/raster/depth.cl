// Alpha and depth of a view, from the blend weights of its pixels.
#include "common.h"
#include "raster/pair_role.h"

// One work-item per pixel: reads its hits, nearest first, and where their points are, writes the
// share of the pixel that is not background, and the depth of that along the camera's axis: the
// mean by weight, and where half of the weight is reached, which grows evenly from hit to hit.
kernel void depth_forward(
    const uint hw,                      // pixels
    global const uint *pixel_offset,    // (HW+1)
    global const ulong *pixel_entry,    // (P) weight << 32 | point; no point: the list ends
    global const float4 *point_camera,  // (N, 4) x, y, z, distance
    global float *pixel_alpha,          // (H, W)
    global float *pixel_depth,          // (H, W) infinite where nothing is hit, as the next
    global float *pixel_median)         // (H, W)
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const uint begin = pixel_offset[q];
    uint end = begin;
    float alpha = 0.0f, depth = 0.0f;
    for (; end < pixel_offset[q + 1] && (uint)pixel_entry[end] != NONE; end++) {
        const float b = as_float((uint)(pixel_entry[end] >> 32));
        alpha += b;
        depth += b * point_camera[(uint)pixel_entry[end]].z;
    }
    float reached = 0.0f, before = 0.0f, median = INFINITY;
    for (uint i = begin; i < end && reached < 0.5f * alpha; i++) {
        const float b = as_float((uint)(pixel_entry[i] >> 32));
        const float z = point_camera[(uint)pixel_entry[i]].z;
        const float share = b > 0.0f ? fmin((0.5f * alpha - reached) / b, 1.0f) : 1.0f;
        median = i == begin ? z : before + share * (z - before);
        reached += b;
        before = z;
    }
    pixel_alpha[q] = fmin(alpha, 1.0f);
    pixel_depth[q] = alpha > 0.0f ? depth / alpha : INFINITY;
    pixel_median[q] = alpha > 0.0f ? median : INFINITY;
}
