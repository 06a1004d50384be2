// The hard disc of the paper: d = 1 everywhere.
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
    floats across2, m2;
    *closeness = 1.0f;
    *depth = f->t;
    return disc_hit(cam, f, rim, column, row, &across2, &m2);
}
