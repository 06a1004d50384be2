// The hard disc of the paper: d = 1 everywhere.
#include "raster/footprint/round.h"

#define MOVES 0  // without offsets
#define surface_range(range, radius, d) (range)
