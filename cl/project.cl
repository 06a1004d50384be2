// Points to camera axes, and which of them are left out.
#include "common.h"
#include "camera.h"
#include "grid.h"
#include "footprint.h"

// Written for a point that is left out, and for one that can hit no pixel.
#define LEFT_OUT (float4)(0.0f, 0.0f, 0.0f, -1.0f)
#define NO_PIXEL (int4)(1, 1, 0, 0)

// Least cosine between a point's direction and the optical axis (Pulsar): nothing behind or beside the eye.
#define LEAST_COSINE 1e-6f

// Writes (x, y, z, t) in camera axes and the box of pixels that may be hit. A point is left out if it is too near or too far
// (measured at the sphere's front, as in Pulsar), behind the eye, or not finite, for which every comparison is false.
inline void project(const Camera *k, const float3 position, const float radius, const int wanted,
                    global float4 *point_camera, global ushort4 *point_box) {
    const float3 c = camera_from_world(k, position);
    const float t = sqrt(c.x * c.x + c.y * c.y + c.z * c.z);
    const float front = t - radius;
    const int kept = wanted & (front >= k->near) & (front <= k->far) & (t > 0.0f) & (c.z >= LEAST_COSINE * t);
    const Footprint f = footprint_load(k, (float4)(c, t), radius);
    const int4 box = footprint_box(k, &f);
    const int visible = kept & (box.z >= box.x) & (box.w >= box.y);
    *point_camera = select(LEFT_OUT, (float4)(c, t), (int4)(-kept));         // a lane with the sign bit takes the second
    *point_box = convert_ushort4(select(NO_PIXEL, box, (int4)(-visible)));
}

// One work-item per point: reads its grid index, writes its camera-space position and distance, and its box of pixels.
kernel void project_grid(
    const uint n,                        // points
    const float radius,                  // of every point
    const uint dropout,                  // a point is left out where its random uint is below this
    const uint seed,                     // of the random uints
    global const float *camera,          // (20) camera.h
    global const float *grid,            // (8) grid.h
    global const uint *point_id,         // (N)
    global float4 *point_camera,         // (N, 4) x, y, z, t; t = -1: left out
    global ushort4 *point_box)           // (N, 4) first x, first y, last x, last y; none where last < first
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const Camera k = camera_load(camera);
    const uint id = point_id[i];
    project(&k, grid_position(grid, id), radius, scramble(id + scramble(seed)) >= dropout, point_camera + i, point_box + i);
}

// One work-item per sphere: reads its position and radius, writes the same as project_grid.
kernel void project_spheres(
    const uint n,                        // spheres
    const uint k,                        // radii: 1 (all alike) or n
    global const float *camera,          // (20) camera.h
    global const float *positions,       // (N, 3) world
    global const float *point_radius,    // (K)
    global float4 *point_camera,         // (N, 4) x, y, z, t; t = -1: left out
    global ushort4 *point_box)           // (N, 4) first x, first y, last x, last y; none where last < first
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const Camera view = camera_load(camera);
    project(&view, vload3(i, positions), point_radius[k == 1 ? 0 : i], 1, point_camera + i, point_box + i);
}
