// Projection: points to camera axes, culling, the box of pixels that each may cover, and how many
// pixels it hits.
#include "common.h"
#include "camera.h"
#include "grid.h"
#include "lanes.h"
#include "cloud.h"
#include "raster/footprint.h"

#ifndef MOST_OFFSET
#define MOST_OFFSET 0.5f  // PointCloud.most_offset of points that are no Gaussians
#endif

// Least cosine between a point's direction and the optical axis (Pulsar): nothing behind or beside
// the eye.
#define LEAST_COSINE 1e-6f

#if FOOTPRINT == SPHERE
// from floor(first) to ceil(last): Pulsar's box is part of its hit rule
#define MARGIN 0.0f
#define ROUND_FIRST 0
#define ROUND_LAST 1
#else
#define MARGIN 0.01f  // pixels; far above the rounding of places
#define ROUND_FIRST 1
#define ROUND_LAST 0
#endif

// First and last pixel along one axis whose centres lie between two places, before clipping to the
// image: -2 to size + 1. low, high: in pixels, less half of one; not bounded: of the whole image.
ALWAYS_INLINE void pixels_between(
    const floats low,
    const floats high,
    const ints bounded,
    const float size,
    ints *first,
    ints *last) {
    const floats from = clamp(select((floats)(-2.0f), low, bounded), -2.0f, size);
    const floats to = clamp(select((floats)(size), high, bounded), -2.0f, size);
    // x + 2 >= 0, so truncation is floor
    *first = LANED(convert_int)(from + 2.0f) - 2 + ROUND_FIRST;
    *last = LANED(convert_int)(to + 2.0f) - 2 + ROUND_LAST;
}

// First and last pixel that a sphere may hit along one axis.
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
    const floats scale = z * z - reach * reach, root = reach * sqrt(u * u + scale);
    const floats low = (u * z - root) / scale * focal + (centre - 0.5f - MARGIN);
    const floats high = (u * z + root) / scale * focal + (centre - 0.5f + MARGIN);
    pixels_between(low, high, z > reach, size, first, last);
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

#if FOOTPRINT == GAUSSIAN
// First and last pixel that a Gaussian may hit along one axis, by its variance there.
ALWAYS_INLINE void gaussian_pixels(
    const floats centre,
    const floats variance,
    const float size,
    ints *first,
    ints *last) {
    const floats reach = DEVIATIONS * sqrt(variance);
    const floats low = centre - reach - (0.5f + MARGIN), high = centre + reach - (0.5f - MARGIN);
    pixels_between(low, high, variance > 0.0f, size, first, last);
}

// How a Gaussian at (x, y, z) in camera axes spreads on the screen. lower: L of its covariance L L^T
// in world axes: its diagonal, then (1, 0), (2, 0), (2, 1). Writes the variances along x and y, and
// Footprints.white.
//
// With the derivative J of the projection and A = J R L, the covariance S = A A^T + v I has the
// determinant |a_0 x a_1|^2 + v (|a_0|^2 + |a_1|^2) + v^2, a sum without cancellation. white is the
// inverse of a triangle U with S = U U^T for v = widened(), and the root of the determinant for v =
// low_pass() by that of S.
ALWAYS_INLINE void gaussian_spread(
    const Camera *cam,
    const floats x,
    const floats y,
    const floats z,
    const floats lower[6],
    floats *variance_x,
    floats *variance_y,
    floats white[4]) {
    const floats across[2] = {x / z, y / z}, scale[2] = {cam->fx / z, cam->fy / z};
    floats a[2][3];
    for (int row = 0; row < 2; row++) {
        const float3 axis = row ? cam->down : cam->right;
        const floats m0 = scale[row] * (axis.x - across[row] * cam->forward.x);
        const floats m1 = scale[row] * (axis.y - across[row] * cam->forward.y);
        const floats m2 = scale[row] * (axis.z - across[row] * cam->forward.z);
        a[row][0] = m0 * lower[0] + m1 * lower[3] + m2 * lower[4];
        a[row][1] = m1 * lower[1] + m2 * lower[5];
        a[row][2] = m2 * lower[2];
    }
    const floats xx = square(a[0][0], a[0][1], a[0][2]), yy = square(a[1][0], a[1][1], a[1][2]);
    const floats xy = a[0][0] * a[1][0] + a[0][1] * a[1][1] + a[0][2] * a[1][2];
    const floats wide = square(
        a[0][1] * a[1][2] - a[0][2] * a[1][1], a[0][2] * a[1][0] - a[0][0] * a[1][2],
        a[0][0] * a[1][1] - a[0][1] * a[1][0]);
    const float least = low_pass(cam), v = widened(cam);
    const floats root = sqrt(wide + v * (xx + yy) + v * v);
    *variance_x = xx + v;
    *variance_y = yy + v;
    white[2] = 1.0f / sqrt(*variance_y);
    white[0] = 1.0f / (root * white[2]);
    white[1] = -xy * white[2] / root;
    white[3] = sqrt(wide + least * (xx + yy) + least * least) / root;
}
#endif

// Points in world axes to camera axes, each with the box of pixels that it may hit; false if none
// hits any, as it is for most points of a crop, and nothing else is known of them then. A point is
// culled, with (0, 0, 0, -1) and no pixel, if it is too near or too far (measured at the sphere's
// front, as in Pulsar), behind the eye, or not finite, for which every comparison is false. lower:
// of Gaussians, as gaussian_spread() has it.
ALWAYS_INLINE bool project(
    const Camera *cam,
    const floats x,
    const floats y,
    const floats z,
    const floats radius,
    const floats lower[6],
    Footprints *f) {
    const floats vx = x - cam->eye.x, vy = y - cam->eye.y, vz = z - cam->eye.z;
    const floats cx = cam->right.x * vx + cam->right.y * vy + cam->right.z * vz;
    const floats cy = cam->down.x * vx + cam->down.y * vy + cam->down.z * vz;
    const floats cz = cam->forward.x * vx + cam->forward.y * vy + cam->forward.z * vz;
    const floats t = sqrt(cx * cx + cy * cy + cz * cz);
    const floats front = t - radius;
    const ints kept =
        (front >= cam->near) & (front <= cam->far) & (t > 0.0f) & (cz >= LEAST_COSINE * t);
    ints x0, y0, x1, y1;
#if FOOTPRINT == GAUSSIAN
    floats variance_x, variance_y;
    gaussian_spread(cam, cx, cy, cz, lower, &variance_x, &variance_y, f->white);
    gaussian_pixels(cx / cz * cam->fx + cam->cx, variance_x, cam->width, &x0, &x1);
    gaussian_pixels(cy / cz * cam->fy + cam->cy, variance_y, cam->height, &y0, &y1);
#else
    const floats wide = fmax(radius, LEAST_RADIUS * t / least_focal(cam));
    const floats reach = FOOTPRINT == SPHERE ? radius : wide;
    const ints near_image = reaches_image(cx, cz, wide, cam->fx, cam->cx, cam->width) &
                            reaches_image(cy, cz, wide, cam->fy, cam->cy, cam->height);
    if (!ANY_LANE(kept & near_image)) return false;
    tangents(cx, cz, reach, cam->fx, cam->cx, cam->width, &x0, &x1);
    tangents(cy, cz, reach, cam->fy, cam->cy, cam->height, &y0, &y1);
#endif
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
    global uint *point_count,
    global float4 *point_white) {
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
#if FOOTPRINT == GAUSSIAN
    LANES_INTO(place[0], f->white[0]);
    LANES_INTO(place[1], f->white[1]);
    LANES_INTO(place[2], f->white[2]);
    LANES_INTO(place[3], f->white[3]);
    for (uint j = 0; j < count; j++)
        point_white[first + j] = (float4)(place[0][j], place[1][j], place[2][j], place[3][j]);
#endif
}

// Whether all points of a brick miss the image, wherever they are in their cells. id: of one of them.
// radius: of a point without offsets.
ALWAYS_INLINE bool
brick_misses(const Camera *cam, global const float *grid, const uint id, const float radius) {
    const float half_side = 0.5f * (BRICK - 1), edge = grid[3];
    const uint first = id >> 3 * BRICK_BITS << 3 * BRICK_BITS;
    const float3 corner = (float3)(grid[0], grid[1], grid[2]) - cam->eye;
    const float3 centre = corner + edge * (convert_float3(grid_vertex(grid, first)) + half_side);
    const float reach = 1.7321f * edge * (half_side + MOST_OFFSET);  // to a corner
    const float pixels = LEAST_RADIUS * (length(centre) + reach) / least_focal(cam);
    const floats wide = reach + fmax(radius * exp(MOST_OFFSET), pixels);
    const floats x = dot(cam->right, centre), y = dot(cam->down, centre);
    const floats z = dot(cam->forward, centre);
    return !ANY_LANE(
        reaches_image(x, z, wide, cam->fx, cam->cx, cam->width) &
        reaches_image(y, z, wide, cam->fy, cam->cy, cam->height));
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
    const uint n,                      // points
    global const float *camera,        // (21) camera.h
    global const float *grid,          // (8) grid.h
    global const uint *point_id,       // (N)
    const float radius,                // of a point without offsets, world units
    global const float *cloud_offset,  // (N, OFFSETS) cloud.h
    global float *point_radius,        // (N)
    global float4 *point_camera,       // (N, 4) x, y, z, t; t = -1: culled
    global ushort4 *point_box,   // (N, 4) first x, first y, last x, last y; none where last < first
    global uint *point_count,    // (N)
    global float4 *point_white)  // (?, 4) (N, 4) Footprints.white of Gaussians; else untouched
{
    const uint first = get_global_id(0) * LANES;
    if (first >= n) return;
    const uint count = min((uint)LANES, n - first);
    const Camera cam = camera_load(camera);
#if LANES > 1 && FOOTPRINT != GAUSSIAN
    // most points of a crop lie beside it
    const uint one = point_id[first], other = point_id[first + count - 1];
    if ((one ^ other) >> 3 * BRICK_BITS == 0 && brick_misses(&cam, grid, one, radius)) {
        for (uint j = 0; j < count; j++)
            point_count[first + j] = 0;
        return;
    }
#endif
    uint id[LANES];
    float offset[9][LANES], radii[LANES];
    for (uint j = 0; j < LANES; j++) {
        const size_t row = first + min(j, count - 1);
        id[j] = point_id[row];
        const Offsets o = OFFSETS_AT(cloud_offset, row);
        offset[0][j] = o.s0;
        offset[1][j] = o.s1;
        offset[2][j] = o.s2;
        offset[3][j] = o.s3;
#if FOOTPRINT == GAUSSIAN
        offset[4][j] = o.s4;
        offset[5][j] = o.s5;
        offset[6][j] = o.s6;
        offset[7][j] = o.s7;
        offset[8][j] = o.s8;
#endif
    }
    // as grid_vertex() has it
    const uints ids = LANES_FROM(id);
    uints x = ids >> 3 * BRICK_BITS;
    uints y = divide(&x, bricks(grid[4]));
    const uints z = divide(&y, bricks(grid[5]));
    const uints i = BRICK * x + (ids & (BRICK - 1));
    const uints j = BRICK * y + (ids >> BRICK_BITS & (BRICK - 1));
    const uints k = BRICK * z + (ids >> 2 * BRICK_BITS & (BRICK - 1));
    Footprints f;
#if FOOTPRINT == GAUSSIAN
    const floats size = radius;  // of the culling alone
    floats lower[6];
    for (uint axis = 0; axis < 3; axis++) {
        lower[axis] = radius * exp(LANES_FROM(offset[3 + axis]));
        lower[3 + axis] = radius * LANES_FROM(offset[6 + axis]);
    }
#else
    const floats size = radius * exp(LANES_FROM(offset[3])), *lower = 0;  // unread
#endif
    const bool any_hit = project(
        &cam, grid[0] + grid[3] * (LANED(convert_float)(i) + LANES_FROM(offset[0])),
        grid[1] + grid[3] * (LANED(convert_float)(j) + LANES_FROM(offset[1])),
        grid[2] + grid[3] * (LANED(convert_float)(k) + LANES_FROM(offset[2])), size, lower, &f);
    store_points(
        &cam, &f, any_hit, first, count, point_camera, point_box, point_count, point_white);
    if (!any_hit) return;
    LANES_INTO(radii, f.radius);
    for (uint j = 0; j < count; j++)
        point_radius[first + j] = radii[j];
}

// One work-item per LANES spheres: reads their positions and radii, writes the same as
// project_grid.
kernel void project_spheres(
    const uint n,                      // spheres
    global const float *camera,        // (21) camera.h
    global const float *positions,     // (N, 3) world
    global const float *point_radius,  // (N)
    global float4 *point_camera,       // (N, 4) x, y, z, t; t = -1: culled
    global ushort4 *point_box,   // (N, 4) first x, first y, last x, last y; none where last < first
    global uint *point_count,    // (N)
    global float4 *point_white)  // (?, 4) as project_grid
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
    const floats radii = LANES_FROM(radius), lower[6] = {radii, radii, radii, 0.0f, 0.0f, 0.0f};
    const bool any_hit =
        project(&cam, LANES_FROM(x), LANES_FROM(y), LANES_FROM(z), radii, lower, &f);
    store_points(
        &cam, &f, any_hit, first, count, point_camera, point_box, point_count, point_white);
}
