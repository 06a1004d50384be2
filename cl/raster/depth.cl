// Alpha, mean depth and median depth of each pixel, from the blend weights of its fragments.
//
// A fragment's depth is where the pixel's ray meets the point: the front of its sphere, or of the
// ball of its radius where footprints are soft. Points stand for what surrounds them, so the
// surface lies in front of their centres.
#include "common.h"
#include "raster/footprint.h"

// One work-item per pixel: reads its fragments, nearest first, and writes the share of the pixel
// that is not background, and the depth of that along the camera's axis: the mean by weight, and
// where half of the weight is reached, which grows evenly from fragment to fragment. A pixel whose
// list an early stop has ended is opaque: the dropped fragments would let less than the stop pass.
kernel void depth_forward(
    const uint hw,                           // pixels
    global const float *camera,              // (21) camera.h
    global const float *point_shape,         // (N, SHAPE) footprint.h
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pair_key,            // (P) depth << 32 | pair, sorted within a pixel
    global const uint2 *pair_point_falloff,  // (P, 2) point, bits of d
    global const ulong *pixel_weight_point,  // (P) weight << 32 | point; no point: the list ends
    global float *pixel_alpha,               // (H, W)
    global float *pixel_depth,               // (H, W) infinite where there is no fragment
    global float *pixel_median)              // (H, W) infinite where there is no fragment
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const Camera cam = camera_load(camera);
    const float axis = camera_ray(&cam, q % cam.width, q / cam.width).z;
    const uint begin = pixel_offset[q];
    uint end = begin;
    float alpha = 0.0f;
    for (; end < pixel_offset[q + 1] && (uint)pixel_weight_point[end] != NONE; end++)
        alpha += as_float((uint)(pixel_weight_point[end] >> 32));
    float depth = 0.0f, reached = 0.0f, before = 0.0f, median = 0.0f;
    for (uint i = begin; i < end; i++) {
        const uint2 fragment = pair_point_falloff[(uint)pair_key[i]];
        const float b = as_float((uint)(pixel_weight_point[i] >> 32));
        const float range = as_float((uint)(pair_key[i] >> 32));
        global const float *shape = point_shape + (size_t)SHAPE * fragment.x;
        const float z = axis * surface_range(range, shape, as_float(fragment.y));
        depth += b * z;
        if (reached < 0.5f * alpha) {
            const float share = b > 0.0f ? fmin((0.5f * alpha - reached) / b, 1.0f) : 1.0f;
            median = i == begin ? z : before + share * (z - before);
        }
        reached += b;
        before = z;
    }
    const bool stopped = end < pixel_offset[q + 1] && alpha > 0.0f;
    pixel_alpha[q] = alpha > 1.0f || stopped ? 1.0f : alpha;  // fmin() would hide a NaN
    const float none = alpha <= 0.0f ? INFINITY : alpha;      // a NaN stays one
    pixel_depth[q] = alpha > 0.0f ? depth / alpha : none;
    pixel_median[q] = alpha > 0.0f ? median : none;
}
