// Rows of what points learn of their places and sizes, from one buffer of OFFSETS floats a point:
// the offset from the vertex of the grid, in voxel sizes, and the logarithm of the radius. Of
// Gaussians in place of that the triangle L of the covariance L L^T, in deviations of one without
// offsets: the logarithms of its diagonal, then (1, 0), (2, 0) and (2, 1), then zeros.
//
// Opacities have rows of OPACITIES: o, then coefficients w_k of the harmonics Y_k of degrees 1 and 2
// (sh.h), for the opacity o + sum_k w_k Y_k(d), in [0, 1], of a point that is seen in the direction
// d from the eye.
#ifndef PP_CLOUD_H
#define PP_CLOUD_H

#ifndef OFFSETS
#define OFFSETS 4  // 16 of Gaussians
#endif

#define OPACITIES 9

#if OFFSETS == 16
typedef float16 Offsets;
#else
typedef float4 Offsets;
#endif

#define OFFSETS_AT(rows, row) ((global Offsets *)(rows))[row]

#endif
