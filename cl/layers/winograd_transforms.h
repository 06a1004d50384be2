// Winograd's minimal filtering F(M x M, 3 x 3), M = WINO_M (Lavin and Gray 2016, arXiv 1509.09308):
// its transforms and its tiles.
//
// Along one line, M outputs y of a kernel w over S = WINO_S = M + 2 samples d are a product of
// polynomials, evaluated at S points: y = A^T [(G w) o (B^T d)]. The functions below apply one
// matrix to S or fewer values `step` apart, in place: along a tile's columns, then its rows.
//
// Points: 0, -1, 1, infinity for M = 2; 0, -P, P, -Q, Q, infinity for M = 4, where P = 3/4 and Q =
// 3/2 halve the float32 error of the usual 1 and 2 and are exact in binary (cf. Barabasz et al.
// 2020, arXiv 1803.10986).
#ifndef PP_WINOGRAD_TRANSFORMS_H
#define PP_WINOGRAD_TRANSFORMS_H
#include "common.h"
#include "layers/tiles.h"

#ifndef WINO_M
#define WINO_M 4  // side of a tile of outputs: 2 or 4
#endif
#ifndef VALUE
#define VALUE float16  // values transformed in step
#endif
#define WINO_S (WINO_M + 2)  // side of a tile of inputs
#define POSITIONS (WINO_S * WINO_S)
#define PER_SIDE (SIDE / WINO_M)  // of tiles.h's tiles

#define POINT_P 0.75f
#define POINT_Q 1.5f
#define POINT_P2 (POINT_P * POINT_P)
#define POINT_Q2 (POINT_Q * POINT_Q)
#define NORM_0 (1 / (POINT_P2 * POINT_Q2))  // 1 / product of the distances of a point to the others
#define NORM_P (1 / (2 * POINT_P2 * (POINT_P2 - POINT_Q2)))
#define NORM_Q (1 / (2 * POINT_Q2 * (POINT_Q2 - POINT_P2)))

// B^T: S samples -> S values.
ALWAYS_INLINE void transform_input(VALUE *t, const int step) {
    const VALUE d0 = t[0], d1 = t[step], d2 = t[2 * step], d3 = t[3 * step];
#if WINO_M == 4
    const VALUE d4 = t[4 * step], d5 = t[5 * step];
    const VALUE even_p = d4 - POINT_Q2 * d2, odd_p = d3 - POINT_Q2 * d1,
                even_q = d4 - POINT_P2 * d2, odd_q = d3 - POINT_P2 * d1;
    t[0] = POINT_P2 * POINT_Q2 * d0 + (d4 - (POINT_P2 + POINT_Q2) * d2);
    t[step] = even_p + POINT_P * odd_p;
    t[2 * step] = even_p - POINT_P * odd_p;
    t[3 * step] = even_q + POINT_Q * odd_q;
    t[4 * step] = even_q - POINT_Q * odd_q;
    t[5 * step] = POINT_P2 * POINT_Q2 * d1 + (d5 - (POINT_P2 + POINT_Q2) * d3);
#else
    t[0] = d0 - d2;
    t[step] = d1 + d2;
    t[2 * step] = d2 - d1;
    t[3 * step] = d3 - d1;
#endif
}

// A^T: S values -> M outputs.
ALWAYS_INLINE void transform_output(VALUE *t, const int step) {
    const VALUE m0 = t[0], sum_p = t[step] + t[2 * step], diff_p = t[step] - t[2 * step];
#if WINO_M == 4
    const VALUE sum_q = t[3 * step] + t[4 * step], diff_q = t[3 * step] - t[4 * step];
    t[0] = m0 + (sum_p + sum_q);
    t[step] = POINT_P * diff_p + POINT_Q * diff_q;
    t[2 * step] = POINT_P2 * sum_p + POINT_Q2 * sum_q;
    t[3 * step] = POINT_P * POINT_P2 * diff_p + (POINT_Q * POINT_Q2 * diff_q + t[5 * step]);
#else
    t[0] = m0 + sum_p;
    t[step] = diff_p + t[3 * step];
#endif
}

// A: gradients of M outputs -> those of S values.
ALWAYS_INLINE void transform_gradient(VALUE *t, const int step) {
    const VALUE g0 = t[0], g1 = t[step];
#if WINO_M == 4
    const VALUE g2 = t[2 * step], g3 = t[3 * step];
    const VALUE even_p = g0 + POINT_P2 * g2, odd_p = g1 + POINT_P2 * g3,
                even_q = g0 + POINT_Q2 * g2, odd_q = g1 + POINT_Q2 * g3;
    t[step] = even_p + POINT_P * odd_p;
    t[2 * step] = even_p - POINT_P * odd_p;
    t[3 * step] = even_q + POINT_Q * odd_q;
    t[4 * step] = even_q - POINT_Q * odd_q;
    t[5 * step] = g3;
#else
    t[step] = g0 + g1;
    t[2 * step] = g0 - g1;
    t[3 * step] = g1;
#endif
}

// G: 3 weights -> S values.
ALWAYS_INLINE void transform_kernel(VALUE *t, const int step) {
    const VALUE w0 = t[0], w1 = t[step], w2 = t[2 * step];
#if WINO_M == 4
    const VALUE even_p = NORM_P * (w0 + POINT_P2 * w2), even_q = NORM_Q * (w0 + POINT_Q2 * w2);
    t[0] = NORM_0 * w0;
    t[step] = even_p + NORM_P * POINT_P * w1;
    t[2 * step] = even_p - NORM_P * POINT_P * w1;
    t[3 * step] = even_q + NORM_Q * POINT_Q * w1;
    t[4 * step] = even_q - NORM_Q * POINT_Q * w1;
    t[5 * step] = w2;
#else
    t[step] = 0.5f * (w0 + w1 + w2);
    t[2 * step] = 0.5f * (w0 - w1 + w2);
    t[3 * step] = w2;
#endif
}

// G^T: gradients of S values -> those of 3 weights.
ALWAYS_INLINE void transform_kernel_gradient(VALUE *t, const int step) {
    const VALUE sum_p = t[step] + t[2 * step], diff_p = t[step] - t[2 * step];
#if WINO_M == 4
    const VALUE sum_q = t[3 * step] + t[4 * step], diff_q = t[3 * step] - t[4 * step];
    t[0] = NORM_0 * t[0] + (NORM_P * sum_p + NORM_Q * sum_q);
    t[step] = NORM_P * POINT_P * diff_p + NORM_Q * POINT_Q * diff_q;
    t[2 * step] = NORM_P * POINT_P2 * sum_p + (NORM_Q * POINT_Q2 * sum_q + t[5 * step]);
#else
    t[0] = t[0] + 0.5f * sum_p;
    t[step] = 0.5f * diff_p;
    t[2 * step] = 0.5f * sum_p + t[3 * step];
#endif
}

// Of a tile of inputs, S x S.
ALWAYS_INLINE void transform_input_tile(VALUE *t) {
#pragma unroll
    for (int i = 0; i < WINO_S; i++)
        transform_input(t + i, WINO_S);
#pragma unroll
    for (int i = 0; i < WINO_S; i++)
        transform_input(t + i * WINO_S, 1);
}

// S x S values of a tile -> M x M outputs, in rows of S.
ALWAYS_INLINE void transform_output_tile(VALUE *t) {
#pragma unroll
    for (int i = 0; i < WINO_S; i++)
        transform_output(t + i, WINO_S);
#pragma unroll
    for (int i = 0; i < WINO_M; i++)
        transform_output(t + i * WINO_S, 1);
}

// 3 x 3 weights, in rows of S -> S x S values.
ALWAYS_INLINE void transform_kernel_tile(VALUE *t) {
#pragma unroll
    for (int i = 0; i < 3; i++)
        transform_kernel(t + i, WINO_S);
#pragma unroll
    for (int i = 0; i < WINO_S; i++)
        transform_kernel(t + i * WINO_S, 1);
}

// The corner of the i-th tile of outputs among those of tile_list: height, width, number, and the
// tiles of tiles.h.
static inline int2 tile_corner(global const int *tile_list, const int i) {
    const int columns = tile_columns(tile_list[1]), tile = tile_list[3 + i / (PER_SIDE * PER_SIDE)];
    const int inside = i % (PER_SIDE * PER_SIDE);
    return (int2)(tile % columns * SIDE + inside % PER_SIDE * WINO_M,
                  tile / columns * SIDE + inside / PER_SIDE * WINO_M);
}

#endif
