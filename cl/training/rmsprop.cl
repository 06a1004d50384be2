// The optimiser of the points: RMSprop (Tieleman & Hinton 2012), that is Adam without a first
// moment (beta1 = 0), with Adam's bias correction folded into rates and eps on the host.
//
// The gradient of coefficient k of the SH is Y_k(direction) G, G being that of the point's
// features, and is never stored. The squares of the harmonics of a degree add up to the same in all
// directions (Unsoeld 1927), so all coefficients of a feature share one second moment v, an average
// of G^2 / (4 pi), which is the mean of Y_k^2 G^2 over the directions. They move by rate Y_k G /
// (sqrt(v) + eps); offset and opacity, each with a second moment of its own, alike. The opacity's
// harmonics (cloud.h) share its second moment. Where the opacity that is seen is at a bound, they
// move only away from it: else they would grow for as long as gradients point beyond the bound.
//
// A point without a gradient stays where it is; the decay of its second moments waits until it has
// one.
#include "common.h"
#include "lanes.h"
#include "cloud.h"
#include "sh.h"

#ifndef RECORD
#define RECORD 8  // words of a point in a view, raster/footprint.h
#endif
#ifndef DEGREE
#define DEGREE 2  // of the highest harmonics to move: 0, 1 or 2
#endif
#ifndef DECAY2
#define DECAY2 0.001f  // 1 - beta2; 1 - 0.999f would be off by 1e-5 of itself
#endif
#ifndef LOG_BETA2
#define LOG_BETA2 -0.00144342f  // log2(beta2)
#endif
#ifndef MOVES_OFFSET
#define MOVES_OFFSET 1  // 0: there is no gradient of the offsets
#endif
#ifndef MOST_OFFSET
#define MOST_OFFSET 0.5f
#endif
#define MEAN_SQUARE 0.07957747f  // 1 / (4 pi), of each harmonic over all directions

#ifdef MOST_SH  // of coefficients above degree 0; without it they have no bounds
#define BOUNDED_SH(value, k)                                                                       \
    ((k) == 0 ? (value) : BOUNDED(value, (floats)(-MOST_SH), (floats)(MOST_SH)))
#else
#define BOUNDED_SH(value, k) (value)
#endif

// Moves `count` coefficients of point i, from basis function `first` on.
#define MOVE(sh, first, count, rate)                                                               \
    {                                                                                              \
        GPU_UNROLLED_FOR (size_t k = 0; k < count; k++) {                                          \
            const size_t at = i * count + k;                                                       \
            const floats moved = load_part(sh, at) - rate * basis[first + k] * scaled;             \
            store_part(BOUNDED_SH(moved, first + k), sh, at);                                      \
        }                                                                                          \
    }

// One work-item per part of a visible point: takes its gradients into the second moments, moves its
// coefficients; the first one moves offset and opacity, and writes the step of the gradient.
kernel void rmsprop_move(
    const uint s,        // visible points
    const uint step,     // from 1
    const float eps,     // of the coefficients: eps * sqrt(1 - beta2^step)
    const float rate_0,  // learning rate * sqrt(1 - beta2^step), by degree
    const float rate_1,
    const float rate_2,
    const float point_eps,  // of offset and opacity, as the next two
    const float rate_offset,
    const float rate_opacity,
    const float rate_lobe,       // of the opacity's harmonics of degree 1; half of it of degree 2
    global const uint *visible,  // (?) their indices, S
    global const float *camera,  // (21) camera.h
    global const uint *point_record,              // (N, RECORD) raster/footprint.h
    global const float16 *grad_visible_features,  // (?, 16) G, a row for each visible point
    global const float *grad_offset,              // (?, OFFSETS) alike, NULL without MOVES_OFFSET
    global const float *grad_opacity,             // (?) alike
    global uint *last_step,                       // (N) of each point's last gradient, 0: none
    global float16 *v,                            // (N, 16)
    global float *v_offset,                       // (N, OFFSETS)
    global float *v_opacity,                      // (N)
    global float *offset,                         // (N, OFFSETS) cloud.h
    global float *opacity,                        // (N, OPACITIES) cloud.h
    global float16 *sh_0,                         // (N, 1, 16)
    global float16 *sh_1,                         // (?, ?, 16) (N, 3, 16), untouched at degree 0
    global float16 *sh_2a,                        // (?, ?, 16) (N, 3, 16), untouched below degree 2
    global float16 *sh_2b)                        // (?, ?, 16) (N, 2, 16), untouched below degree 2
{
    const uint row = get_global_id(0) / ROW_PARTS;
    const size_t g = min(row, s - 1), i = visible[g];
    const size_t soon = visible[min(row + POINTS_AHEAD, s - 1)];
    READ_AHEAD(v + soon);
    SH_READ_AHEAD(soon)
    const uint last = last_step[i];
#if ROW_PARTS > 1
    barrier(CLK_GLOBAL_MEM_FENCE);  // all parts of a point have read it
#endif
    const Offsets offsets = MOVES_OFFSET ? OFFSETS_AT(grad_offset, g) : (Offsets)(0.0f);
    const Offsets o = BOUNDED_GRADIENT(Offsets, offsets);
    const float a = BOUNDED_GRADIENT(float, grad_opacity[g]);
    // a NaN is a gradient
    if (row >= s || !(any(grad_visible_features[g] != 0.0f) || any(o != 0.0f) || a != 0.0f)) return;
    const float decay = exp2((step - last) * LOG_BETA2);
    float basis[9];
    const float4 at = as_float4(vload4(i * (size_t)(RECORD / 4), point_record));
    sh_basis_of_point(camera, at, basis);
    if (ROW_PART == 0) {
        last_step[i] = step;
        const float w = decay * v_opacity[i] + DECAY2 * a * a;
        v_opacity[i] = w;
        const float move = a / (sqrt(w) + point_eps);
        global float *learned = opacity + OPACITIES * i;
        float seen = learned[0];
        for (uint k = 1; k < OPACITIES; k++)
            seen += basis[k] * learned[k];
        const bool stays = a < 0.0f ? seen >= 1.0f : seen <= 0.0f;
        learned[0] = BOUNDED(learned[0] - rate_opacity * move, 0.0f, 1.0f);
        for (uint k = 1; k < OPACITIES && !stays; k++) {
            const float moved = learned[k] - (k < 4 ? 1.0f : 0.5f) * rate_lobe * basis[k] * move;
            learned[k] = BOUNDED(moved, -1.0f, 1.0f);
        }
        if (MOVES_OFFSET) {
            const Offsets u = decay * OFFSETS_AT(v_offset, i) + DECAY2 * o * o, most = MOST_OFFSET;
            OFFSETS_AT(v_offset, i) = u;
            const Offsets shifted = OFFSETS_AT(offset, i) - rate_offset * o / (sqrt(u) + point_eps);
            OFFSETS_AT(offset, i) = BOUNDED(shifted, -most, most);
        }
    }
    const floats G = BOUNDED_GRADIENT(floats, load_part(grad_visible_features, g));
    const floats moment = decay * load_part(v, i) + DECAY2 * MEAN_SQUARE * (G * G);
    store_part(moment, v, i);
    const floats scaled = G / (sqrt(moment) + eps);
    MOVE(sh_0, 0, 1, rate_0)
    if (DEGREE >= 1) MOVE(sh_1, 1, 3, rate_1)
    if (DEGREE >= 2) {
        MOVE(sh_2a, 4, 3, rate_2)
        MOVE(sh_2b, 7, 2, rate_2)
    }
}
