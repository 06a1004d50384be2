// Projection: points to camera axes, culling, the box of pixels that each may cover, and how many
// pixels it hits.
#include "common.h"
#include "camera.h"
#include "grid.h"
#include "lanes.h"
#include "raster/footprint.h"

// Least cosine between a point's direction and the optical axis (Pulsar): nothing behind or beside
// the eye.
#define LEAST_COSINE 1e-6f

// First and last pixel that may be hit along one axis, before clipping to the image: -2 to size +
// 1.
//
// The tangents from the eye to a circle of radius r at (u, z), u = x or y, have slopes m with (m z
// - u)^2 = r^2 (1 + m^2); a circle that reaches the eye's plane has no bounds.
ALWAYS_INLINE void tangents(
    const floats u,
    const floats z,
    const floats reach,
    const float focal,
    const float centre,
    const float size,
    ints *first,
    ints *last) {
#if FOOTPRINT == SPHERE
    // from floor(first) to ceil(last): Pulsar's box is part of its hit rule
    const float margin = 0.0f;
    const int round_first = 0, round_last = 1;
#else
    const float margin = 0.01f;  // pixels; far above the rounding of the slopes
    const int round_first = 1, round_last = 0;
#endif
    const floats scale = z * z - reach * reach, root = reach * sqrt(u * u + scale);
    const floats low = (u * z - root) / scale * focal + (centre - 0.5f - margin);
    const floats high = (u * z + root) / scale * focal + (centre - 0.5f + margin);
    const ints bounded = z > reach;
    const floats from = clamp(select((floats)(-2.0f), low, bounded), -2.0f, size);
    const floats to = clamp(select((floats)(size), high, bounded), -2.0f, size);
    // x + 2 >= 0, so truncation is floor
    *first = LANED(convert_int)(from + 2.0f) - 2 + round_first;
    *last = LANED(convert_int)(to + 2.0f) - 2 + round_last;
}

// Whether circles around (u, z), u = x or y, come so near to the image along that axis that they
// may hit a pixel. Their distance from the plane through the eye and one of its sides, of slope m,
// is (u - m z) / sqrt(1 + m^2).
ALWAYS_INLINE ints reaches_image(
    const floats u,
    const floats z,
    const floats reach,
    const float focal,
    const float centre,
    const float size) {
    const float low = -centre / focal, high = (size - centre) / focal;
    const floats wide = 1.25f * reach;  // far above rounding
    return (u - low * z >= -(1.0f + fabs(low)) * wide) &
           (high * z - u >= -(1.0f + fabs(high)) * wide);
}

// Points in world axes to camera axes, each with the box of pixels that it may hit; false if none
// hits any, as it is for most points of a crop, and nothing else is known of them then. A point is
// culled, with (0, 0, 0, -1) and no pixel, if it is too near or too far (measured at the sphere's
// front, as in Pulsar), behind the eye, or not finite, for which every comparison is false.
ALWAYS_INLINE bool project(
    const Camera *cam,
    const floats x,
    const floats y,
    const floats z,
    const floats radius,
    Footprints *f) {
    const floats vx = x - cam->eye.x, vy = y - cam->eye.y, vz = z - cam->eye.z;
    const floats cx = cam->right.x * vx + cam->right.y * vy + cam->right.z * vz;
    const floats cy = cam->down.x * vx + cam->down.y * vy + cam->down.z * vz;
    const floats cz = cam->forward.x * vx + cam->forward.y * vy + cam->forward.z * vz;
    const floats t = sqrt(cx * cx + cy * cy + cz * cz);
    const floats front = t - radius;
    const ints kept =
        (front >= cam->near) & (front <= cam->far) & (t > 0.0f) & (cz >= LEAST_COSINE * t);
    const floats least = LEAST_RADIUS * t / least_focal(cam);
    const floats wide =
        FOOTPRINT == GAUSSIAN ? gaussian_reach(cam, radius, cz) : fmax(radius, least);
    const floats reach = FOOTPRINT == SPHERE ? radius : wide;
    const ints near_image = reaches_image(cx, cz, wide, cam->fx, cam->cx, cam->width) &
                            reaches_image(cy, cz, wide, cam->fy, cam->cy, cam->height);
    if (!ANY_LANE(kept & near_image)) return false;
    ints x0, y0, x1, y1;
    tangents(cx, cz, reach, cam->fx, cam->cx, cam->width, &x0, &x1);
    tangents(cy, cz, reach, cam->fy, cam->cy, cam->height, &y0, &y1);
    x0 = max(x0, (ints)(0));
    y0 = max(y0, (ints)(0));
    x1 = min(x1, (ints)(cam->width - 1));
    y1 = min(y1, (ints)(cam->height - 1));
    const ints visible = kept & (x1 >= x0) & (y1 >= y0);

    f->x = select((floats)(0.0f), cx, kept);
    f->y = select((floats)(0.0f), cy, kept);
    f->z = select((floats)(0.0f), cz, kept);
    f->t = select((floats)(-1.0f), t, kept);
    f->radius = radius;
    // no pixel: last before first
    LANES_INTO(f->box[0], select((ints)(1), x0, visible));
    LANES_INTO(f->box[1], select((ints)(1), y0, visible));
    LANES_INTO(f->box[2], select((ints)(0), x1, visible));
    LANES_INTO(f->box[3], select((ints)(0), y1, visible));
    footprints_prepare(cam, f);
    return true;
}

// The number of pixels that each point hits, by testing all pixels of its box.
ALWAYS_INLINE ints count_hits(const Camera *cam, const Footprints *f) {
    ints hits = 0;
    floats closeness, depth;
    for (int row = 0; row < f->rows; row++)
        for (int column = 0; column < f->columns; column++)
            hits += footprints_hit(cam, f, column, row, &closeness, &depth) & 1;
    return hits;
}

// Writes the camera-space positions of `count` points from `first` on, their boxes and numbers of
// hits; of points of which none hits a pixel, only these numbers.
ALWAYS_INLINE void store_points(
    const Camera *cam,
    const Footprints *f,
    const bool any_hit,
    const uint first,
    const uint count,
    global float4 *point_camera,
    global ushort4 *point_box,
    global uint *point_count) {
    if (!any_hit) {
        for (uint j = 0; j < count; j++)
            point_count[first + j] = 0;
        return;
    }
    float place[4][LANES];
    int hits[LANES];
    LANES_INTO(place[0], f->x);
    LANES_INTO(place[1], f->y);
    LANES_INTO(place[2], f->z);
    LANES_INTO(place[3], f->t);
    LANES_INTO(hits, count_hits(cam, f));
    for (uint j = 0; j < count; j++) {
        const uint i = first + j;
        point_camera[i] = (float4)(place[0][j], place[1][j], place[2][j], place[3][j]);
        point_box[i] = (ushort4)(f->box[0][j], f->box[1][j], f->box[2][j], f->box[3][j]);
        point_count[i] = hits[j];
    }
}

// id / n lane by lane, which no vector instruction does; *id becomes the remainder.
ALWAYS_INLINE uints divide(uints *id, const uint n) {
    const uints low = mul_hi(*id, (uints)(UINT_MAX / n));  // at most 1 too small
    const uints rest = *id - low * n;
    const uints more = select((uints)(0), (uints)(1), rest >= n);
    *id = rest - more * n;
    return low + more;
}

// One work-item per LANES points: reads their grid indices and offsets, writes their numbers of
// hits and, if any is above 0, their radii, camera-space positions and distances, and boxes.
kernel void project_grid(
    const uint n,                       // points
    global const float *camera,         // (20) camera.h
    global const float *grid,           // (8) grid.h
    global const uint *point_id,        // (N)
    const float radius,                 // of a point without offsets, world units
    global const float4 *cloud_offset,  // (N, 4) from the vertex, in edges; log of the radius
    global float *point_radius,         // (N)
    global float4 *point_camera,        // (N, 4) x, y, z, t; t = -1: culled
    global ushort4 *point_box,  // (N, 4) first x, first y, last x, last y; none where last < first
    global uint *point_count)   // (N)
{
    const uint first = get_global_id(0) * LANES;
    if (first >= n) return;
    const uint count = min((uint)LANES, n - first);
    const Camera cam = camera_load(camera);
    uint id[LANES];
    float offset[4][LANES], radii[LANES];
    for (uint j = 0; j < LANES; j++) {
        const size_t row = first + min(j, count - 1);
        id[j] = point_id[row];
        offset[0][j] = cloud_offset[row].x;
        offset[1][j] = cloud_offset[row].y;
        offset[2][j] = cloud_offset[row].z;
        offset[3][j] = cloud_offset[row].w;
    }
    // as grid_position() has it
    uints i = LANES_FROM(id);
    uints j = divide(&i, (uint)grid[4]);
    const uints k = divide(&j, (uint)grid[5]);
    Footprints f;
    const bool any_hit = project(
        &cam, grid[0] + grid[3] * (LANED(convert_float)(i) + LANES_FROM(offset[0])),
        grid[1] + grid[3] * (LANED(convert_float)(j) + LANES_FROM(offset[1])),
        grid[2] + grid[3] * (LANED(convert_float)(k) + LANES_FROM(offset[2])),
        radius * exp(LANES_FROM(offset[3])), &f);
    store_points(&cam, &f, any_hit, first, count, point_camera, point_box, point_count);
    if (!any_hit) return;
    LANES_INTO(radii, f.radius);
    for (uint j = 0; j < count; j++)
        point_radius[first + j] = radii[j];
}

// One work-item per LANES spheres: reads their positions and radii, writes the same as
// project_grid.
kernel void project_spheres(
    const uint n,                      // spheres
    global const float *camera,        // (20) camera.h
    global const float *positions,     // (N, 3) world
    global const float *point_radius,  // (N)
    global float4 *point_camera,       // (N, 4) x, y, z, t; t = -1: culled
    global ushort4 *point_box,  // (N, 4) first x, first y, last x, last y; none where last < first
    global uint *point_count)   // (N)
{
    const uint first = get_global_id(0) * LANES;
    if (first >= n) return;
    const uint count = min((uint)LANES, n - first);
    const Camera cam = camera_load(camera);
    float x[LANES], y[LANES], z[LANES], radius[LANES];
    for (uint j = 0; j < LANES; j++) {
        const uint i = first + min(j, count - 1);
        x[j] = positions[3 * i];
        y[j] = positions[3 * i + 1];
        z[j] = positions[3 * i + 2];
        radius[j] = point_radius[i];
    }
    Footprints f;
    const bool any_hit =
        project(&cam, LANES_FROM(x), LANES_FROM(y), LANES_FROM(z), LANES_FROM(radius), &f);
    store_points(&cam, &f, any_hit, first, count, point_camera, point_box, point_count);
}
