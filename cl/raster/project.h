#ifndef PP_PROJECT_H
#define PP_PROJECT_H
// Projection: points to camera axes, culling, the box of pixels that each may cover, and how many
// pixels it covers.
#include "common.h"
#include "camera.h"
#include "lanes.h"
#include "scan.h"
#include "raster/footprint.h"

// Least cosine between a point's direction and the optical axis (Pulsar): nothing behind or beside
// the eye.
#define LEAST_COSINE 1e-6f

// Points in world axes to camera axes, each with the box of pixels that it may cover; false if none
// covers any, as it is for most points of a crop, and nothing else is known of them then. A point
// is culled, with (0, 0, 0, -1) and no pixel, if it is too near or too far (measured at the
// sphere's front, as in Pulsar), behind the eye, or not finite, for which every comparison is
// false. radius: of the culling. form: as the kind of footprint has it.
ALWAYS_INLINE bool project(
    const Camera *cam,
    const floats x,
    const floats y,
    const floats z,
    const floats radius,
    const floats form[FORM],
    Footprints *f) {
    const floats vx = x - cam->eye.x, vy = y - cam->eye.y, vz = z - cam->eye.z;
    f->x = cam->right.x * vx + cam->right.y * vy + cam->right.z * vz;
    f->y = cam->down.x * vx + cam->down.y * vy + cam->down.z * vz;
    f->z = cam->forward.x * vx + cam->forward.y * vy + cam->forward.z * vz;
    f->t = sqrt(f->x * f->x + f->y * f->y + f->z * f->z);
    const floats front = f->t - radius;
    const ints drawn =
        (front >= cam->near) & (front <= cam->far) & (f->t > 0.0f) & (f->z >= LEAST_COSINE * f->t);
    ints first[2], last[2];
    if (!footprints_box(cam, form, drawn, f, first, last)) return false;
    const ints x0 = max(first[0], (ints)(0)), x1 = min(last[0], (ints)(cam->width - 1));
    const ints y0 = max(first[1], (ints)(0)), y1 = min(last[1], (ints)(cam->height - 1));
    const ints in_image = drawn & (x1 >= x0) & (y1 >= y0);
    f->x = select((floats)(0.0f), f->x, drawn);
    f->y = select((floats)(0.0f), f->y, drawn);
    f->z = select((floats)(0.0f), f->z, drawn);
    f->t = select((floats)(-1.0f), f->t, drawn);
    // no pixel: last before first
    LANES_INTO(f->box[0], select((ints)(1), x0 / SIDE, in_image));
    LANES_INTO(f->box[1], select((ints)(1), y0 / SIDE, in_image));
    LANES_INTO(f->box[2], select((ints)(0), x1 / SIDE, in_image));
    LANES_INTO(f->box[3], select((ints)(0), y1 / SIDE, in_image));
    footprints_measure(f);
    return true;
}

// The number of pixels that each point covers, by testing all pixels of its box.
ALWAYS_INLINE ints count_fragments(const Camera *cam, const Footprints *f) {
    const Rim rim = footprints_rim(cam, f);
    ints fragments = 0;
    for (int row = 0; row < f->rows; row++)
        for (int column = 0; column < f->columns; column++)
            fragments += footprints_test(f, &rim, column, row).covers & 1;
    return fragments;
}

// Projects `count` points and writes them from `first` on: positions in camera axes, shapes, boxes
// and numbers of fragments, whose sum it returns; of points of which none covers a pixel, only these
// numbers.
ALWAYS_INLINE uint project_points(
    const Camera *cam,
    const floats x,
    const floats y,
    const floats z,
    const floats radius,
    const floats form[FORM],
    const uint first,
    const uint count,
    global float4 *point_camera,
    global float *point_shape,
    global ushort4 *point_box,
    global uint *point_count) {
    Footprints f;
    if (!project(cam, x, y, z, radius, form, &f)) {
        for (uint j = 0; j < count; j++)
            point_count[first + j] = 0;
        return 0;
    }
    uint sum = 0;
    float place[4][LANES], shape[SHAPE][LANES];
    int fragments[LANES];
    LANES_INTO(place[0], f.x);
    LANES_INTO(place[1], f.y);
    LANES_INTO(place[2], f.z);
    LANES_INTO(place[3], f.t);
    GPU_UNROLLED_FOR (uint k = 0; k < SHAPE; k++)
        LANES_INTO(shape[k], f.shape[k]);
    LANES_INTO(fragments, count_fragments(cam, &f));
    for (uint j = 0; j < count; j++) {
        const uint i = first + j;
        point_camera[i] = (float4)(place[0][j], place[1][j], place[2][j], place[3][j]);
        GPU_UNROLLED_FOR (uint k = 0; k < SHAPE; k++)
            point_shape[SHAPE * i + k] = shape[k][j];
        point_box[i] = (ushort4)(f.box[0][j], f.box[1][j], f.box[2][j], f.box[3][j]);
        point_count[i] = fragments[j];
        sum = add_sat(sum, (uint)fragments[j]);
    }
    return sum;
}

#endif
