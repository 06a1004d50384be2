// Projection of spheres anywhere, as raster/project.h does it: no training needs it.
#include "common.h"
#include "camera.h"
#include "lanes.h"
#include "scan.h"
#include "raster/project.h"

// GROUP work-items per block of BLOCK spheres: read their positions and radii, write the same as
// project_grid.
kernel void project_spheres(
    const uint n,                      // spheres
    global const float *camera,        // (21) camera.h
    global const float *positions,     // (N, 3) world
    global const float *point_radius,  // (N)
    global float4 *point_camera,       // (N, 4) x, y, z, t; t = -1: culled
    global float *point_shape,         // (N, SHAPE) footprint.h
    global ushort4 *point_box,  // (N, 4) first x, first y, last x, last y; none where last < first
    global uint *point_count,   // (N)
    global uint *block_sum)     // ((N+BLOCK-1)/BLOCK) of point_count
{
    SHARED(uint, shared, 2 * GROUP);
    const uint begin = GROUP_ID * BLOCK, end = min(n, begin + BLOCK);
    if (begin >= n) return;
    const Camera cam = camera_load(camera);
    uint sum = 0, total;
    for (uint first = begin + MEMBER * LANES; first < end; first += GROUP * LANES) {
        const uint count = min((uint)LANES, end - first);
        float x[LANES], y[LANES], z[LANES], radius[LANES];
        for (uint j = 0; j < LANES; j++) {
            const uint i = first + min(j, count - 1);
            x[j] = positions[3 * i];
            y[j] = positions[3 * i + 1];
            z[j] = positions[3 * i + 2];
            radius[j] = point_radius[i];
        }
        const floats radii = LANES_FROM(radius);
        floats form[FORM];
        GPU_UNROLLED_FOR (uint k = 0; k < FORM; k++)
            form[k] = k < LOGS ? radii : 0.0f;
        sum = add_sat(
            sum, project_points(
                     &cam, LANES_FROM(x), LANES_FROM(y), LANES_FROM(z), radii, form, first, count,
                     point_camera, point_shape, point_box, point_count));
    }
    group_scan(sum, shared, &total);
    if (MEMBER == 0) block_sum[GROUP_ID] = total;
}
