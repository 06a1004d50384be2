#ifndef PP_PROJECT_H
#define PP_PROJECT_H
// Projection: points to camera axes, culling, the box of pixels that each may cover, and how many
// tiles the box touches.
#include "common.h"
#include "camera.h"
#include "lanes.h"
#include "scan.h"
#include "raster/footprint.h"

// Least cosine between a point's direction and the optical axis (Pulsar): nothing behind or beside
// the eye.
#define LEAST_COSINE 1e-6f

// Points in world axes to camera axes, each with the box of samples that it may cover; false if none
// covers any, as it is for most points of a crop, and nothing else is known of them then. A point
// is culled if it is too near or too far (measured at the front of its ball, as in Pulsar), behind
// the eye, or not finite, for which every comparison is false. in_image: not 0 of those that are
// left. radius: of the culling. form: as the kind of footprint has it.
ALWAYS_INLINE bool project(
    const Camera *cam,
    const floats x,
    const floats y,
    const floats z,
    const floats radius,
    const floats form[FORM],
    Footprints *f,
    ints *in_image) {
    const floats vx = x - cam->eye.x, vy = y - cam->eye.y, vz = z - cam->eye.z;
    f->x = cam->right.x * vx + cam->right.y * vy + cam->right.z * vz;
    f->y = cam->down.x * vx + cam->down.y * vy + cam->down.z * vz;
    f->z = cam->forward.x * vx + cam->forward.y * vy + cam->forward.z * vz;
    f->t = sqrt(f->x * f->x + f->y * f->y + f->z * f->z);
    const floats front = f->t - radius;
    const ints drawn =
        (front >= cam->near) & (front <= cam->far) & (f->t > 0.0f) & (f->z >= LEAST_COSINE * f->t);
    if (!footprints_box(cam, form, drawn, f)) return false;
    f->first[0] = max(f->first[0], 0);
    f->first[1] = max(f->first[1], 0);
    f->last[0] = min(f->last[0], cam->width - 1);
    f->last[1] = min(f->last[1], cam->height - 1);
    *in_image = drawn & (f->last[0] >= f->first[0]) & (f->last[1] >= f->first[1]);
    return true;
}

// The number of tiles that each point's box touches.
ALWAYS_INLINE ints count_tiles(const Footprints *f, const ints in_image) {
    const ints wide = f->last[0] / 16 - f->first[0] / 16 + 1;  // 16 samples
    const ints high = f->last[1] / 16 - f->first[1] / 16 + 1;
    return select((ints)(0), wide * high, in_image);
}

#endif
