// The depth loss (ours): how far the surface bends from pixel to pixel. With the mean depth z of a
// pixel's fragments, in voxels along the camera's axis, it is the mean over the pixels of the sum
// of rho(c), c = z(-s) - 2 z(0) + z(s), over both axes and strides s of 1, 2 and 4 pixels. A plane
// has c = 0. rho(c) = c^2 / (1 + c^2 / S^2) is Geman and McClure's (1985): an edge, where c is far
// above S, is left alone. A pixel that is not opaque, or whose neighbour is not, has no such term.
//
// z = axis sum b t / (voxel_size sum b) of ranges t, so dz/db_i = axis (t_i - mean) / (voxel_size
// sum b): raster/blend.cl adds dL/db_i, its slope times t_i - mean, to G.f_i.
#include "camera.h"
#include "common.h"

#ifndef SUPERSAMPLING
#define SUPERSAMPLING 1  // samples of a pixel along each axis
#endif
#define OPAQUE 0.9f  // the least alpha of a pixel with a surface
#define S2 4.0f      // S = 2 voxels
#define FARTHEST 4   // the longest stride, pixels

// One work-item per pixel: writes its surface.
kernel void pixel_surface(
    const uint hw,                      // pixels
    const float voxel_size,             // world units
    global const float *camera,         // (21) camera.h, of the samples
    global const float *transmittance,  // (HW)
    global const float *mean_range,     // (HW) raster/weights.cl
    global float4 *surface)             // (HW, 4) z, mean range, dz/db_i over t_i - mean; 0
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const Camera cam = camera_load(camera);
    const uint width = cam.width / SUPERSAMPLING;
    const float x = (SUPERSAMPLING * (q % width + 0.5f) - cam.cx) / cam.fx;
    const float y = (SUPERSAMPLING * (q / width + 0.5f) - cam.cy) / cam.fy;
    const float axis = 1.0f / sqrt(x * x + y * y + 1.0f);
    const float alpha = 1.0f - transmittance[q], per_voxel = axis / voxel_size;
    const float range = mean_range[q];
    const float4 found = (float4)(per_voxel * range, range, per_voxel / alpha, 0.0f);
    surface[q] = alpha < OPAQUE ? (float4)(0.0f) : found;  // a NaN stays one
}

// rho'(c) at a pixel, the middle of three that are `step` apart; 0 where one has no surface.
ALWAYS_INLINE float slope(global const float4 *surface, const uint q, const uint step) {
    const float before = surface[q - step].x, here = surface[q].x, after = surface[q + step].x;
    if (before == 0.0f || here == 0.0f || after == 0.0f) return 0.0f;
    const float c = (before - here) - (here - after), flat = 1.0f + c * c / S2;
    return 2.0f * c / (flat * flat);
}

// The derivative of the sum of rho(c) along a line of `count` pixels, `step` apart, by z of its
// pixel `at`, which is q.
ALWAYS_INLINE float along(
    global const float4 *surface,
    const uint q,
    const uint at,
    const uint count,
    const uint step) {
    float sum = 0.0f;
    for (uint s = 1; s <= FARTHEST; s *= 2) {
        if (at >= s && at + s < count) sum -= 2.0f * slope(surface, q, s * step);
        if (at >= 2 * s) sum += slope(surface, q - s * step, s * step);
        if (at + 2 * s < count) sum += slope(surface, q + s * step, s * step);
    }
    return sum;
}

// One work-item per pixel: reads the surfaces around it, writes dL/db_i over t_i - mean, and the
// mean.
kernel void depth_gradient(
    const uint h,                   // pixels
    const uint w,                   //
    const float weight,             // of the loss
    global const float4 *surface,   // (H*W, 4) of pixel_surface
    global float2 *depth_gradient)  // (H*W, 2)
{
    const uint q = get_global_id(0);
    if (q >= h * w) return;
    const float4 own = surface[q];
    const float sum = along(surface, q, q % w, w, 1) + along(surface, q, q / w, h, w);
    depth_gradient[q] = (float2)(weight / (h * w) * own.z * sum, own.y);
}
