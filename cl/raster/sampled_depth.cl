// Alpha, mean depth and median depth of each pixel with several samples, as depth.cl has them of one.
#include "raster/samples.h"
#include "reduce.h"

// The mean of the depths of the samples that lie within a voxel of the nearest, as others show what
// is behind an edge; infinite where all are. A NaN stays one.
ALWAYS_INLINE float mean_of_nearest(const floats depth, const float voxel_size) {
    float of_sample[SAMPLES], nearest = INFINITY, sum = 0.0f;
    LANES_INTO(of_sample, depth);
    for (uint k = 0; k < SAMPLES; k++)
        nearest = of_sample[k] < nearest ? of_sample[k] : nearest;
    uint count = 0;
    for (uint k = 0; k < SAMPLES; k++)
        if (!(of_sample[k] > nearest + voxel_size)) {
            sum += of_sample[k];
            count++;
        }
    return sum / count;
}

// One work-item per pixel: reads its fragments, nearest first, twice, and writes the share of the
// pixel that is not background, and the depths of its surface along the camera's axis.
kernel void sampled_depth(
    const uint hw,                           // pixels
    const float early_stop,                  // T behind which fragments were dropped; 0: none
    const float voxel_size,                  // world units
    global const float *camera,              // (21) camera.h, of the samples
    global const float4 *point_camera,       // (N, 4) x, y, z, distance
    global const float *point_shape,         // (N, SHAPE) footprint.h
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pair_key,            // (P) depth << 32 | pair, sorted within a pixel
    global const uint *pair_point,           // (P, 1)
    global const ulong *pixel_weight_point,  // (P) weight << 32 | point; no point: the list ends
    global const float *opacity,             // (N)
    global float *pixel_alpha,               // (H, W)
    global float *pixel_depth,               // (H, W) infinite where there is no fragment
    global float *pixel_median)              // (H, W) infinite where there is no fragment
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const Camera cam = camera_load(camera);
    const Rays m = rays_of(&cam, q);
    const floats none = INFINITY;
    floats alpha = 0.0f, depth = 0.0f, median = 0.0f;
    ints is_stopped = 0;
    for (uint pass = 0; pass < 2; pass++) {
        floats T = 1.0f, reached = 0.0f, before = 0.0f;
        ints is_behind = 0;  // another fragment of the sample
        for (uint i = pixel_offset[q]; i < pixel_offset[q + 1]; i++) {
            if ((uint)pixel_weight_point[i] == NONE) break;
            const uint point = pair_point[(uint)pair_key[i]];
            const float4 c = point_camera[point];
            const floats d = falloffs(&m, c, reach_of(&cam, c, point_shape, point));
            const ints shows = (T >= early_stop) & (d != 0.0f);
            const floats b = select((floats)(0.0f), T * (opacity[point] * d), shows);
            const floats through = 1.0f - opacity[point] * d;
            T *= select(
                (floats)(1.0f), select(through, (floats)(LEAST_THROUGH), through < LEAST_THROUGH),
                shows);
            if (pass == 0) {
                alpha += b;
                continue;
            }
            const floats ball = FOOTPRINT == SOFT ? point_shape[(size_t)SHAPE * point] *
                                                        sqrt(fmax(d * (2.0f - d), 0.0f))
                                                  : (floats)(0.0f);
            const floats z = m.per_length * (upper_float(pair_key[i]) - ball);
            depth += select((floats)(0.0f), b * z, shows);
            const floats half_left = 0.5f * alpha - reached;
            const floats share = select((floats)(1.0f), fmin(half_left / b, 1.0f), b > 0.0f);
            const floats there = select(z, before + share * (z - before), is_behind);
            median = select(median, there, shows & (half_left > 0.0f));
            reached += b;
            before = select(before, z, shows);
            is_behind |= shows;
        }
        is_stopped = T < early_stop;
    }
    const ints is_empty = alpha <= 0.0f;  // a rounding below 0 at the very rim; a NaN stays one
    pixel_depth[q] = mean_of_nearest(select(depth / alpha, none, is_empty), voxel_size);
    pixel_median[q] = mean_of_nearest(select(median, none, is_empty), voxel_size);
    alpha = select(alpha, (floats)(1.0f), is_stopped | (alpha > 1.0f));
    pixel_alpha[q] = SUM_LANES(alpha) / SAMPLES;
}
