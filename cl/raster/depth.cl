// Alpha, mean depth and median depth of each pixel, from the blend weights of its fragments.
//
// A fragment's depth is where a sample's ray meets the point: the front of its sphere, or of the
// ball of its radius where footprints are soft. Points stand for what surrounds them, so the
// surface lies in front of their centres.
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
// pixel that is not background, and the depth of that along the camera's axis: the mean by weight,
// and where half of the weight is reached, which grows evenly from fragment to fragment. A sample
// that an early stop has ended is opaque: what it dropped would let less than the stop pass.
kernel void depth_forward(
    const uint hw,                           // pixels
    const float early_stop,                  // T behind which fragments were dropped; 0: none
    const float voxel_size,                  // world units
    global const float *camera,              // (21) camera.h, of the samples
    global const float4 *point_camera,       // (N, 4) x, y, z, distance; read of several samples
    global const float *point_shape,         // (N, SHAPE) footprint.h
    global const uint *pixel_offset,         // (HW+1)
    global const ulong *pair_key,            // (P) depth << 32 | pair, sorted within a pixel
    global const uint *pair_point_falloff,   // (P, ?) point, with one sample bits of d
    global const ulong *pixel_weight_point,  // (P) weight << 32 | point; no point: the list ends
    global const float *opacity,             // (N) read of several samples
    global float *pixel_alpha,               // (H, W)
    global float *pixel_depth,               // (H, W) infinite where there is no fragment
    global float *pixel_median)              // (H, W) infinite where there is no fragment
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const Camera cam = camera_load(camera);
    const Rays m = rays_of(&cam, q);
    const floats none = 0.0f;
    floats alpha = 0.0f, depth = 0.0f, median = 0.0f;
    ints is_stopped = 0;
    for (uint pass = 0; pass < 2; pass++) {
        floats T = 1.0f, reached = 0.0f, before = 0.0f;
        ints is_behind = 0;  // another fragment of the sample
        uint i = pixel_offset[q];
        for (; i < pixel_offset[q + 1] && (uint)pixel_weight_point[i] != NONE; i++) {
            const Fragment f = fragment_load(
                (uint)pair_key[i], &cam, &m, point_camera, point_shape, pair_point_falloff);
#if SAMPLES == 1
            const ints shows = 1;
            const floats b = upper_float(pixel_weight_point[i]);
#else
            const ints shows = (T >= early_stop) & (f.falloff != 0.0f);
            const floats seen = select(none, opacity[f.point] * f.falloff, shows);
            const floats b = T * seen;
            T = transmit(T, seen);
#endif
            if (pass == 0) {
                alpha += b;
                continue;
            }
            const floats z = m.per_length * surface_range(
                                                upper_float(pair_key[i]),
                                                point_shape[(size_t)SHAPE * f.point], f.falloff);
            depth += b * z;
            const floats half_left = 0.5f * alpha - reached;
            const floats share = select((floats)(1.0f), fmin(half_left / b, 1.0f), b > 0.0f);
            const floats there = select(z, before + share * (z - before), is_behind);
            median = select(median, there, shows & (half_left > 0.0f));
            reached += b;
            before = select(before, z, shows);
            is_behind |= shows;
        }
        is_stopped = SAMPLES == 1 ? (ints)(i < pixel_offset[q + 1]) : T < early_stop;
    }
    const ints is_there = alpha > 0.0f;
    // infinite without weight, as where rounding at the very rim leaves less than 0; a NaN stays one
    const floats missing = select(alpha, (floats)(INFINITY), alpha <= 0.0f);
    pixel_depth[q] = mean_of_nearest(select(missing, depth / alpha, is_there), voxel_size);
    pixel_median[q] = mean_of_nearest(select(missing, median, is_there), voxel_size);
    alpha = select(alpha, (floats)(1.0f), (is_stopped & is_there) | (alpha > 1.0f));
    pixel_alpha[q] = SUM_LANES(alpha) / SAMPLES;
}
