// Pulsar's sphere of any radius: its depth is that of its front, its distance from the ray that at
// the centre's range.
#define PULSAR 1
#include "raster/footprint/round.h"

#define surface_range(range, shape, d) (range)

ALWAYS_INLINE ints footprints_hit(
    const Camera *cam,
    const Footprints *f,
    const Rim *rim,
    const int column,
    const int row,
    floats *closeness,
    floats *depth) {
#pragma OPENCL FP_CONTRACT OFF
    const floats radius = f->shape[0];
    floats mx, my, m2;
    const ints inside = ray_of_box(cam, f, rim, column, row, &mx, &my, &m2);
    const floats nearly = 1.0f / sqrt(m2);  // as in reciprocal()
    const floats inverse = nearly + 0.5f * nearly * fma(-m2 * nearly, nearly, (floats)(1.0f));
    const floats range = f->t * inverse;
    const floats dx = f->x - range * mx, dy = f->y - range * my, dz = f->z - range;
    const floats rho = sqrt(square(dx, dy, dz));  // the expanded square would cancel
    const ints through = rho < rim->least;
    *closeness = clamp(1.0f - rho / radius, 0.0f, 1.0f);
    *closeness = select(*closeness, (floats)(1.0f), rim->tiny && through);
    const floats along = fmin((f->x * mx + f->y * my + f->z) * inverse, f->t);
    const floats wx = f->x - along * inverse * mx, wy = f->y - along * inverse * my;
    const floats wz = f->z - along * inverse;
    const floats w = sqrt(square(wx, wy, wz));  // distance of the centre from the ray
    *depth = fmax(along - sqrt((radius + w) * fmax(radius - w, 0.0f)), 0.0f);
    return inside && (rho <= radius || through);
}
