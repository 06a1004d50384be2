// The weights of fragments in samples, on a walk along a tile's list.
//
// Front-to-back alpha compositing, with opacity o, falloff d and transmittance T of the fragments
// that a sample sees:
//
// alpha_i = o_i d_i,  b_i = T_i alpha_i,  T_(i+1) = T_i (1 - alpha_i),  T_1 = 1
//
// The background gets the transmittance T behind all fragments. An opaque fragment lets
// LEAST_THROUGH pass. A sample drops the fragments behind the depth where its T falls below
// early_stop, as they could weigh no more than T in all.
//
// Eq. (1) of the PlenopticPoints supplemental is a sample's softmax over its fragments, with z, which
// is 1 at the near sphere and 0 at the far one; index 0 stands for the background:
//
// a_i = o_i z_i/gamma,  b_i = o_i d_i exp(a_i - M)/D,  b_0 = exp(EPS/gamma - M)/D
//
// M is the largest of EPS/gamma and the a_i where d_i > 0, D the sum of all numerators. No exponent
// is positive, and D does not vanish: a_i > 1 means o_i > gamma, and a d_i > 0 is at least 6e-8;
// without any, b_0's numerator is at least 1/e.
//
// z and the exponents are written as fma(): NVIDIA's compiler fuses products and sums at some
// places only, and equal fragments got different weights.
#ifndef PP_COMPOSITING_H
#define PP_COMPOSITING_H

#include "raster/tiles.h"

#ifndef SOFTMAX
#define SOFTMAX 0
#endif
#define EPS 1e-6f  // depth of the background, as a z (Pulsar's background_normalized_depth)

// What is the same for all samples. limit: early_stop of alpha compositing, at least 1e-20, since the
// way back divides by what T was multiplied with; 1/gamma of the softmax.
typedef struct {
    float limit;
    float near, per_depth;
} Rule;

ALWAYS_INLINE Rule rule_of(const Camera *cam, const float limit) {
    return (Rule){limit, cam->near, 1.0f / (cam->far - cam->near)};
}

ALWAYS_INLINE floats pass_through(const floats alpha) {
    const floats through = 1.0f - alpha;  // fmax() would hide a NaN
    return select(through, (floats)(LEAST_THROUGH), through < LEAST_THROUGH);
}

// z of Eq. (1).
ALWAYS_INLINE float normalised_depth(const Rule *rule, const Point *p) {
    return fma(rule->near - DEPTH(p), rule->per_depth, 1.0f);
}

#if SOFTMAX
typedef struct {
    floats M, per_D;
    ints end;  // fragments from this rank on are dropped
} Sample;

// inside: the samples in the image; the others see nothing.
#define SAMPLE_BEGIN(s, tile, own, inside)                                                         \
    (s).M = SAMPLE_VALUES(const floats, sample_state, SAMPLE_ROW(tile, own));                      \
    (s).per_D =                                                                                    \
        SAMPLE_VALUES(const floats, sample_state, SAMPLE_ROW(tile, own) + BLOCKS * (size_t)tiles); \
    (s).end = SAMPLE_VALUES(const ints, sample_end, SAMPLE_ROW(tile, own));

// exp(a - M), where a = o z / gamma is above M by more than a rounding only where d = 0.
ALWAYS_INLINE floats exponential(const float o_z, const float sharpness, const floats M) {
    return exp(fmin(-fma((floats)(-o_z), (floats)(sharpness), M), 0.0f));
}

// b / o of the point with this rank in the list, or 0, and the samples in which it is not dropped.
ALWAYS_INLINE floats share_of(
    const Sample *s,
    const Rule *rule,
    const Point *p,
    const Coverage *at,
    const int rank,
    ints *shows) {
    const float o_z = p->opacity * normalised_depth(rule, p);
    *shows = at->covers & (rank < s->end);
    const floats share = at->falloff * exponential(o_z, rule->limit, s->M) * s->per_D;
    return select((floats)(0.0f), share, *shows);
}

ALWAYS_INLINE floats weigh(
    Sample *s,
    const Rule *rule,
    const Point *p,
    const Coverage *at,
    const int rank,
    ints *shows) {
    return p->opacity * share_of(s, rule, p, at, rank, shows);
}
#else
typedef struct {
    floats T;
} Sample;

#define SAMPLE_BEGIN(s, tile, own, inside) (s).T = select((floats)(-1.0f), (floats)(1.0f), inside);

// The alphas of a point where it shows in samples with T in front, 0 elsewhere.
ALWAYS_INLINE floats alpha_of(const Point *p, const Coverage *at, ints *shows) {
    floats alpha = p->opacity * at->falloff;
    SHOWN_ALPHA(alpha, *shows)
    return select((floats)(0.0f), alpha, *shows);
}

// The weights of the next point of the list, or 0, and the samples in which it is not dropped.
ALWAYS_INLINE floats weigh(
    Sample *s,
    const Rule *rule,
    const Point *p,
    const Coverage *at,
    const int rank,
    ints *shows) {
    const floats before = s->T;
    *shows = at->covers & (before >= rule->limit);
    const floats alpha = alpha_of(p, at, shows);
    s->T = before * pass_through(alpha);
    return before * alpha;
}
#endif

#endif
