// What tiles write by pair for the gradients of points (blend.cl), and points sum (gather.cl).
#ifndef PP_SUMS_H
#define PP_SUMS_H

// Of a pair beside the features: b, dL/do, and with gradients of offsets what derivatives_add() adds.
#if MOVED
#define SUMS 8
#define LOAD_SUMS vload8
#define STORE_SUMS vstore8
typedef float8 Sums;
#else
#define SUMS 2
#define LOAD_SUMS vload2
#define STORE_SUMS vstore2
typedef float2 Sums;
#endif

// Whether a point's box touches one tile, which then writes the gradient of its features itself;
// clamped ones need their values.
#define IS_IN_ONE_TILE(p)                                                                          \
    (!CLAMPED && (p).first.x / TILE_SIDE == (p).last.x / TILE_SIDE &&                              \
     (p).first.y / TILE_SIDE == (p).last.y / TILE_SIDE)

#endif
