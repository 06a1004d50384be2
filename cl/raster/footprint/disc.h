// The hard disc of the paper: d = 1 everywhere.
#include "raster/footprint/round.h"

#define surface_range(range, radius, d) (range)

ALWAYS_INLINE Coverage
footprints_cover(const Footprints *f, const Rim *rim, const floats px, const floats py) {
    floats distance2;
    return (Coverage){disc_covers(f, rim, px, py, &distance2), (floats)(1.0f), f->t};
}
