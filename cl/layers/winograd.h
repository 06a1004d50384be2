// Winograd's minimal filtering F(4 x 4, 3 x 3) on CPUs (Lavin and Gray 2016, arXiv 1509.09308):
// tiles of 16 channels a vector, transformed in a slice of scratch memory for each compute unit.
//
// Along one line, M = 4 outputs y of a kernel w over S = 6 samples d are a product of polynomials,
// evaluated at S points: y = A^T [(G w) o (B^T d)]. The functions below apply one matrix to S or
// fewer values `step` apart, in place: along a tile's columns, then its rows.
//
// Points: 0, -P, P, -Q, Q, infinity, where P = 3/4 and Q = 3/2 halve the float32 error of the usual
// 1 and 2 and are exact in binary (cf. Barabasz et al. 2020, arXiv 1803.10986).
#ifndef PP_WINOGRAD_H
#define PP_WINOGRAD_H
#include "common.h"
#include "layers/tiles.h"

#define WINO_M SIDE          // side of a tile of outputs
#define WINO_S (WINO_M + 2)  // side of a tile of inputs
#define POSITIONS (WINO_S * WINO_S)

#define POINT_P 0.75f
#define POINT_Q 1.5f
#define POINT_P2 (POINT_P * POINT_P)
#define POINT_Q2 (POINT_Q * POINT_Q)
#define NORM_0 (1 / (POINT_P2 * POINT_Q2))  // 1 / product of the distances of a point to the others
#define NORM_P (1 / (2 * POINT_P2 * (POINT_P2 - POINT_Q2)))
#define NORM_Q (1 / (2 * POINT_Q2 * (POINT_Q2 - POINT_P2)))

// B^T: S samples -> S values.
ALWAYS_INLINE void transform_input(float16 *t, const int step) {
    const float16 d0 = t[0], d1 = t[step], d2 = t[2 * step], d3 = t[3 * step];
    const float16 d4 = t[4 * step], d5 = t[5 * step];
    const float16 even_p = d4 - POINT_Q2 * d2, odd_p = d3 - POINT_Q2 * d1,
                  even_q = d4 - POINT_P2 * d2, odd_q = d3 - POINT_P2 * d1;
    t[0] = POINT_P2 * POINT_Q2 * d0 + (d4 - (POINT_P2 + POINT_Q2) * d2);
    t[step] = even_p + POINT_P * odd_p;
    t[2 * step] = even_p - POINT_P * odd_p;
    t[3 * step] = even_q + POINT_Q * odd_q;
    t[4 * step] = even_q - POINT_Q * odd_q;
    t[5 * step] = POINT_P2 * POINT_Q2 * d1 + (d5 - (POINT_P2 + POINT_Q2) * d3);
}

// A^T: S values -> M outputs.
ALWAYS_INLINE void transform_output(float16 *t, const int step) {
    const float16 m0 = t[0], sum_p = t[step] + t[2 * step], diff_p = t[step] - t[2 * step];
    const float16 sum_q = t[3 * step] + t[4 * step], diff_q = t[3 * step] - t[4 * step];
    t[0] = m0 + (sum_p + sum_q);
    t[step] = POINT_P * diff_p + POINT_Q * diff_q;
    t[2 * step] = POINT_P2 * sum_p + POINT_Q2 * sum_q;
    t[3 * step] = POINT_P * POINT_P2 * diff_p + (POINT_Q * POINT_Q2 * diff_q + t[5 * step]);
}

// A: gradients of M outputs -> those of S values.
ALWAYS_INLINE void transform_gradient(float16 *t, const int step) {
    const float16 g0 = t[0], g1 = t[step];
    const float16 g2 = t[2 * step], g3 = t[3 * step];
    const float16 even_p = g0 + POINT_P2 * g2, odd_p = g1 + POINT_P2 * g3,
                  even_q = g0 + POINT_Q2 * g2, odd_q = g1 + POINT_Q2 * g3;
    t[step] = even_p + POINT_P * odd_p;
    t[2 * step] = even_p - POINT_P * odd_p;
    t[3 * step] = even_q + POINT_Q * odd_q;
    t[4 * step] = even_q - POINT_Q * odd_q;
    t[5 * step] = g3;
}

// G: 3 weights -> S values.
ALWAYS_INLINE void transform_kernel(float16 *t, const int step) {
    const float16 w0 = t[0], w1 = t[step], w2 = t[2 * step];
    const float16 even_p = NORM_P * (w0 + POINT_P2 * w2), even_q = NORM_Q * (w0 + POINT_Q2 * w2);
    t[0] = NORM_0 * w0;
    t[step] = even_p + NORM_P * POINT_P * w1;
    t[2 * step] = even_p - NORM_P * POINT_P * w1;
    t[3 * step] = even_q + NORM_Q * POINT_Q * w1;
    t[4 * step] = even_q - NORM_Q * POINT_Q * w1;
    t[5 * step] = w2;
}

// G^T: gradients of S values -> those of 3 weights.
ALWAYS_INLINE void transform_kernel_gradient(float16 *t, const int step) {
    const float16 sum_p = t[step] + t[2 * step], diff_p = t[step] - t[2 * step];
    const float16 sum_q = t[3 * step] + t[4 * step], diff_q = t[3 * step] - t[4 * step];
    t[0] = NORM_0 * t[0] + (NORM_P * sum_p + NORM_Q * sum_q);
    t[step] = NORM_P * POINT_P * diff_p + NORM_Q * POINT_Q * diff_q;
    t[2 * step] = NORM_P * POINT_P2 * sum_p + (NORM_Q * POINT_Q2 * sum_q + t[5 * step]);
}

// Of a tile of inputs, S x S.
ALWAYS_INLINE void transform_input_tile(float16 *t) {
    UNROLLED_FOR (int i = 0; i < WINO_S; i++)
        transform_input(t + i, WINO_S);
    UNROLLED_FOR (int i = 0; i < WINO_S; i++)
        transform_input(t + i * WINO_S, 1);
}

// S x S values of a tile -> M x M outputs, in rows of S.
ALWAYS_INLINE void transform_output_tile(float16 *t) {
    UNROLLED_FOR (int i = 0; i < WINO_S; i++)
        transform_output(t + i, WINO_S);
    UNROLLED_FOR (int i = 0; i < WINO_M; i++)
        transform_output(t + i * WINO_S, 1);
}

// 3 x 3 weights, in rows of S -> S x S values.
ALWAYS_INLINE void transform_kernel_tile(float16 *t) {
    UNROLLED_FOR (int i = 0; i < 3; i++)
        transform_kernel(t + i, WINO_S);
    UNROLLED_FOR (int i = 0; i < WINO_S; i++)
        transform_kernel(t + i * WINO_S, 1);
}

// Transformed weights are laid out (position, 16 output channels a block, input channel, 16). One
// vector more between two positions keeps these apart in the sets of a cache.
#define WEIGHT_AT(position, block, blocks, channels)                                               \
    ((position) * ((blocks) * (channels) + 1) + (block) * (channels))

// Values of so many tiles at once are laid out (position, 16 channels, tile); vectors from one
// position to the next. The odd one keeps the positions apart in the sets of a cache.
#define PITCH(channels, tiles) ((channels) / 16 * (tiles) + 1)

// The corner of the i-th tile of tile_list: height, width, number, and the tiles of tiles.h.
static inline int2 listed_corner(global const int *tile_list, const int i) {
    return tile_corner(tile_list[3 + i], tile_list[1]);
}

// A scratch begins with a vector for counters, all 0 between kernels: how much of the work is taken,
// of two kinds, and how many work-items found nothing more to take. Which work-item takes what
// changes no result: a compute unit that is late or slow takes less.
#define COUNTERS 1
#define TILE_WORK 0
#define SUM_WORK 1

// The first of the next n pieces of work of a kind.
static inline int take(global float16 *scratch, const int kind, const int n) {
    return atomic_add((volatile global int *)scratch + kind, n);
}

// Called once by each work-item, after it took more than there is.
static inline void leave(global float16 *scratch) {
    volatile global int *counters = (volatile global int *)scratch;
    if (atomic_inc(counters + 2) == (int)get_global_size(0) - 1)
        for (int i = 0; i < 3; i++)
            atomic_xchg(counters + i, 0);
}

// The `side` x `side` pixels from (x0, y0) on, 16 channels each, into rows of t that are S apart; 0
// outside the image. A tile across the border is gathered in `patch` first, so that one piece of
// straight code loads them all.
ALWAYS_INLINE void load_tile(
    float16 *t,
    const int side,             // S or M
    global float *patch,        // POSITIONS vectors
    global const float *image,  // at the first of the 16 channels
    const int channels,         // of a pixel
    const int x0,
    const int y0,
    const int height,
    const int width) {
    global const float *corner = image + ((long)y0 * width + x0) * channels;
    int row = width * channels, column = channels;
    if (x0 < 0 || y0 < 0 || x0 + side > width || y0 + side > height) {
        for (int i = 0; i < POSITIONS; i++) {
            const int x = x0 + i % WINO_S, y = y0 + i / WINO_S;
            float16 pixel = 0.0f;
            if (x >= 0 && x < width && y >= 0 && y < height)
                pixel = vload16(0, corner + i / WINO_S * row + i % WINO_S * column);
            vstore16(pixel, i, patch);
        }
        corner = patch;
        row = WINO_S * 16;
        column = 16;
    }
    UNROLLED_FOR (int i = 0; i < POSITIONS; i++)
        if (i % WINO_S < side && i / WINO_S < side)
            t[i] = vload16(0, corner + i / WINO_S * row + i % WINO_S * column);
}

// v = B^T d B of the inputs d of `padded` tiles of tile_list from `first` on, 16 * chunks channels;
// the last of `count` is repeated. tiles: for which v has room.
ALWAYS_INLINE void transform_tiles(
    global float16 *v,
    const int pitch,
    const int tiles,
    global float *patch,    // POSITIONS vectors
    global const float *x,  // at the first of the channels
    const int channels,     // of a pixel
    const int chunks,
    global const int *tile_list,
    const int first,
    const int count,
    const int padded) {
    const int height = tile_list[0], width = tile_list[1];
    for (int tile = 0; tile < padded; tile++) {
        const int2 corner = listed_corner(tile_list, first + min(tile, count - 1)) - 1;
        for (int chunk = 0; chunk < chunks; chunk++) {
            float16 t[POSITIONS];
            load_tile(
                t, WINO_S, patch, x + chunk * 16, channels, corner.x, corner.y, height, width);
            transform_input_tile(t);
            UNROLLED_FOR (int i = 0; i < POSITIONS; i++)
                v[i * pitch + chunk * tiles + tile] = t[i];
        }
    }
}

#endif
