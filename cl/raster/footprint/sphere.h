// Pulsar's sphere of any radius: its depth is that of its front, its distance from the ray that at
// the centre's range.
#define PULSAR 1
#include "raster/footprint/round.h"

#define surface_range(range, radius, d) (range)

ALWAYS_INLINE Coverage
footprints_cover(const Footprints *f, const Rim *rim, const floats px, const floats py) {
#pragma OPENCL FP_CONTRACT OFF
    const floats radius = f->shape[0];
    const floats mx = (px + rim->left) * rim->per_fx, my = (py + rim->top) * rim->per_fy;
    const floats m2 = mx * mx + my * my + 1.0f;  // of the ray (mx, my, 1)
    const floats nearly = 1.0f / sqrt(m2);       // as in reciprocal()
    const floats inverse = nearly + 0.5f * nearly * fma(-m2 * nearly, nearly, (floats)(1.0f));
    const floats range = f->t * inverse;
    const floats dx = f->x - range * mx, dy = f->y - range * my, dz = f->z - range;
    const floats rho = sqrt(square(dx, dy, dz));  // the expanded square would cancel
    const ints through = rho < rim->least;
    const floats d = clamp(1.0f - rho / radius, 0.0f, 1.0f);
    const floats along = fmin((f->x * mx + f->y * my + f->z) * inverse, f->t);
    const floats wx = f->x - along * inverse * mx, wy = f->y - along * inverse * my;
    const floats wz = f->z - along * inverse;
    const floats w = sqrt(square(wx, wy, wz));  // distance of the centre from the ray
    const floats half_chord = sqrt((radius + w) * fmax(radius - w, 0.0f));
    return (Coverage){
        rho <= radius || through, select(d, (floats)(1.0f), rim->tiny && through),
        fmax(along - half_chord, 0.0f)};
}
