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

#ifndef TILES
#define TILES 64  // tiles transformed and multiplied at a time
#endif

#ifndef BLOCKS
#define BLOCKS 2  // groups of 16 output channels multiplied together; divides their number
#endif
#ifndef TOGETHER
// tiles multiplied together: BLOCKS * TOGETHER accumulators and BLOCKS weights fit AVX-512
#define TOGETHER 8
#endif

#define WINO_M MAP_TILE      // side of a tile of outputs
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

// The first of the next n pieces of work of a kind, 0: tiles, or 1: parts of sums.
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

// The convolution of an image, for the forward pass (winograd.cl) and the gradient of its input
// (winograd_backward.cl): cut into tiles of M x M outputs, TILES or less of which go through three
// stages at a time: the input tiles are transformed, multiplied position by position as matrices
// (tiles x CI) (CI x CO), and transformed back. What lies between the stages stays in a work-item's
// own slice of `scratch`, small enough for the caches. There is one work-item per compute unit, in
// work-groups of 1: an image's tiles are many, and each slice is used over and over.

// Vectors of a work-item's scratch: the values of ci channels, their products of co channels, a
// patch for load_tile.
#define SLICE(ci, co) (POSITIONS * (PITCH(ci, TILES) + PITCH(co, TILES) + 1))

// Stage 2: m (position, 16 of co, tile) = v (position, 16 of ci, tile) times the transformed
// weights.
ALWAYS_INLINE void multiply(
    global float16 *m,
    global const float16 *v,
    global const float16 *transformed,
    const int ci,
    const int blocks,
    const int padded) {
    for (int position = 0; position < POSITIONS; position++)
        for (int block = 0; block < blocks; block += BLOCKS)
            for (int tile = 0; tile < padded; tile += TOGETHER) {
                float16 acc[BLOCKS][TOGETHER];
                UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                    UNROLLED_FOR (int i = 0; i < TOGETHER; i++)
                        acc[b][i] = 0.0f;
                for (int chunk = 0; chunk < ci / 16; chunk++) {
                    global const float *value =
                        (global const float *)(v + position * PITCH(ci, TILES) + chunk * TILES +
                                               tile);
                    const int weight = WEIGHT_AT(position, block, blocks, ci) + chunk * 16;
#pragma unroll 4
                    for (int c = 0; c < 16; c++) {
                        float16 wc[BLOCKS];
                        UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                            wc[b] = transformed[weight + b * ci + c];
                        UNROLLED_FOR (int i = 0; i < TOGETHER; i++)
                            UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                                acc[b][i] += value[i * 16 + c] * wc[b];
                    }
                }
                UNROLLED_FOR (int b = 0; b < BLOCKS; b++)
                    UNROLLED_FOR (int i = 0; i < TOGETHER; i++)
                        m[position * PITCH(blocks * 16, TILES) + (block + b) * TILES + tile + i] =
                            acc[b][i];
            }
}

// Stage 3: the outputs of `count` tiles of tile_list from `first` on, co1 channels of them to out and
// co2 to out2, plus bias (0 = none); with relu, max(., 0) of them; with a mask of either, 0 where it
// is not positive.
ALWAYS_INLINE void transform_back(
    global float *out,
    global float *out2,
    global const float16 *m,
    global const float16 *bias,
    const int relu,
    global const float *mask,
    global const float *mask2,
    const int co1,
    const int co2,
    global const int *tile_list,
    const int first,
    const int count) {
    const int height = tile_list[0], width = tile_list[1], pitch = PITCH(co1 + co2, TILES);
    for (int tile = 0; tile < count; tile++) {
        const int2 corner = listed_corner(tile_list, first + tile);
        for (int block = 0; block < (co1 + co2) / 16; block++) {
            const bool second = block >= co1 / 16;
            const int channels = second ? co2 : co1, c0 = block * 16 - (second ? co1 : 0);
            global const float *masking = second ? mask2 : mask;
            global float *to = second ? out2 : out;
            float16 t[POSITIONS];
            UNROLLED_FOR (int i = 0; i < POSITIONS; i++)
                t[i] = m[i * pitch + block * TILES + tile];
            transform_output_tile(t);
            const float16 offset = bias ? bias[block] : (float16)0.0f;
            UNROLLED_FOR (int i = 0; i < WINO_M; i++)
                UNROLLED_FOR (int j = 0; j < WINO_M; j++)
                    if (corner.y + i < height && corner.x + j < width) {
                        const size_t at =
                            ((size_t)(corner.y + i) * width + corner.x + j) * channels + c0;
                        float16 value = t[i * WINO_S + j] + offset;
                        if (relu)  // max(., 0) would hide a NaN
                            value = select(value, (float16)0.0f, value < 0.0f);
                        if (masking)
                            value = select((float16)0.0f, value, vload16(0, masking + at) > 0.0f);
                        vstore16(value, 0, to + at);
                    }
        }
    }
}

// The whole convolution of [x, x2] (c2 = 0: of x) for the tiles that this work-item takes; bias,
// relu, mask, out: as in transform_back.
ALWAYS_INLINE void convolve(
    global const float *x,
    global const float *x2,
    const int c1,
    const int c2,
    global const float16 *transformed,
    global const float16 *bias,
    const int relu,
    global const float *mask,
    global const float *mask2,
    global float *out,
    global float *out2,
    const int co1,
    const int co2,
    global const int *tile_list,
    global float16 *scratch,  // all work-items'
    global float16 *v)        // the work-item's slice of it
{
    const int ci = c1 + c2, co = co1 + co2;
    global float16 *m = v + POSITIONS * PITCH(ci, TILES);
    global float *patch = (global float *)(m + POSITIONS * PITCH(co, TILES));

    const int tiles = tile_list[2];
    const int share = (tiles + get_global_size(0) - 1) / get_global_size(0);
    const int rounds = (share + TILES - 1) / TILES;  // of about the same size
    const int step = ((share + rounds - 1) / rounds + TOGETHER - 1) / TOGETHER * TOGETHER;
    for (int first; (first = take(scratch, 0, step)) < tiles;) {
        const int count = min(step, tiles - first),
                  padded = (count + TOGETHER - 1) / TOGETHER * TOGETHER;
        for (int source = 0; source < (c2 ? 2 : 1); source++)
            transform_tiles(
                v + (source ? c1 / 16 * TILES : 0), PITCH(ci, TILES), TILES, patch, source ? x2 : x,
                source ? c2 : c1, (source ? c2 : c1) / 16, tile_list, first, count, padded);
        multiply(m, v, transformed, ci, co / 16, padded);
        transform_back(out, out2, m, bias, relu, mask, mask2, co1, co2, tile_list, first, count);
    }
    leave(scratch);
}

#endif
