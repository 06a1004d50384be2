// What the kernels of both blends are built with, and whether pairs have roles by that.
#ifndef PP_DROPS_H
#define PP_DROPS_H

#ifndef DROPS
#define DROPS 1  // early_stop may be above 0
#endif
#ifndef BY_PAIR
#define BY_PAIR 1  // 0: no weights by pair, which only gradients and pruning need
#endif
#ifndef MAX_TRACKED
#define MAX_TRACKED 0  // nearest hits of a pixel that get gradients; 0: all
#endif
#define HAS_ROLES (DROPS || MAX_TRACKED)
#include "raster/pair_role.h"

#endif
