// The soft disc (ours): d falls linearly from the centre to the rim.
#include "raster/footprint/round.h"

ALWAYS_INLINE Coverage
footprints_cover(const Footprints *f, const Rim *rim, const floats px, const floats py) {
#pragma OPENCL FP_CONTRACT OFF
    floats distance2;
    const ints covers = disc_covers(f, rim, px, py, &distance2);
    return (Coverage){covers, 1.0f - sqrt(distance2) * rim->per_reach, f->t};
}

// The surface is that of the ball. d: at the rim a rounding below 0.
ALWAYS_INLINE floats surface_range(const float range, const float radius, const floats d) {
    return range - radius * sqrt(select(d * (2.0f - d), (floats)(0.0f), d < 0.0f));
}
