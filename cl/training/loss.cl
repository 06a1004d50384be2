// L = mean D(p - t) + weight * (1 - mean SSIM) of a prediction p and a target t, and dL/dp.
//
// D is smooth L1 (Girshick 2015): d^2 / (2 beta) where |d| < beta, else |d| - beta/2; L1 at beta 0.
//
// SSIM (Wang et al. 2004): 11x11 Gaussian windows of sigma 1.5 that lie inside the target,
// population variances, per channel. With d = p - t and s = p + t it is (1 - a)(1 - b), a = E[d]^2
// / P, b = Var[d] / Q, P = (E[d]^2 + E[s]^2)/2 + C1, Q = (Var[d] + Var[s])/2 + C2: the usual
// formula, but one that does not cancel where p = t. An image row is a flat vector of 3 values a
// pixel, so a step of one pixel is a step of 3 values.
//
// The kernels run in their order here: moments of the windows along y; along x, then SSIM and its
// derivatives; derivatives summed along x; along y, with the gradient; sums. Scratch rows are
// BLOCKS vectors of LANES values long, MARGIN more than 3W values need, so that no tap along x
// needs a test.
#include "group.h"
#include "lanes.h"

#ifndef TAPS
#define TAPS 11  // pixels, the side of a window
#endif
#ifndef MARGIN
#define MARGIN (32 / LANES)  // vectors, >= 3 * (TAPS - 1) values
#endif
#define C1 1e-4f  // (0.01 * 1)^2: the constants of Wang et al. for a range of 1
#define C2 9e-4f  // (0.03 * 1)^2

constant float WINDOW[TAPS] = {// exp(-x^2 / (2 * 1.5^2)), normalised
                               0.00102838008f, 0.00759875814f, 0.0360007721f, 0.109360689f,
                               0.213005538f,   0.266011725f,   0.213005538f,  0.109360689f,
                               0.0360007721f,  0.00759875814f, 0.00102838008f};

// s is kept 1 lower: the moments of numbers around 0 lose the least
#define SUM_SHIFT 1.0f

// One work-item per LANES values of a row of windows: writes the moments of d, s, d^2, s^2 over 11
// image rows.
kernel void loss_moments(
    const uint v,                    // rows of windows, H - 10
    const uint w,                    // width of the target
    const uint pw,                   // width of the prediction
    const uint corner,               // first value of the prediction under the target
    const uint blocks,               // vectors in a scratch row
    global const float *prediction,  // (PH, PW, 3)
    global const float *target,      // (H, W, 3)
    global float *moments)           // (V, 4, BLOCKS, LANES)
{
    const int b = get_global_id(0), y = get_global_id(1);
    if (b >= blocks || y >= v) return;
    const int count = 3 * (int)w - LANES * b;
    floats m_d = 0.0f, m_s = 0.0f, m_dd = 0.0f, m_ss = 0.0f;
    for (int k = 0; k < TAPS && count > 0; k++) {
        const floats p =
            load_lanes(prediction + corner + 3 * (size_t)pw * (y + k) + LANES * b, count);
        const floats t = load_lanes(target + 3 * (size_t)w * (y + k) + LANES * b, count);
        const floats d = p - t, s = p + t - SUM_SHIFT;
        m_d += WINDOW[k] * d;
        m_s += WINDOW[k] * s;
        m_dd += WINDOW[k] * d * d;
        m_ss += WINDOW[k] * s * s;
    }
    global floats *row = (global floats *)moments + 4 * (size_t)blocks * y + b;
    row[0] = m_d;
    row[blocks] = m_s;
    row[2 * blocks] = m_dd;
    row[3 * blocks] = m_ss;
}

// LANES values of a scratch row blurred from value i on; each tap lies `step` values beside the one
// before.
static inline floats blur_along_x(global const floats *row, const int i, const int step) {
    global const float *values = (global const float *)row + i;
    floats sum = 0.0f;
    for (int k = 0; k < TAPS; k++)
        sum += WINDOW[k] * LANES_FROM(values + step * k);
    return sum;
}

// One work-item per LANES values of a row of windows, shifted right by MARGIN: finishes the moments
// along x, writes what the windows give to the loss and its derivatives: dL/dp of a pixel is the
// window-weighted sum of [0] + [1] d + [2] s.
kernel void loss_similarity(
    const uint v,                  // rows of windows
    const uint w,                  // width of the target
    const uint blocks,             // vectors in a scratch row
    const float weight,            // of 1 - SSIM
    global const float *moments,   // (V, 4, BLOCKS, LANES)
    global float *derivatives,     // (V, 3, BLOCKS, LANES) 0 outside the windows
    global float4 *partial_terms)  // (ROWS, BLOCKS, 4) rows 0 to V - 1
{
    const int b = get_global_id(0), y = get_global_id(1);
    if (b >= blocks || y >= v) return;
    floats derivative_0 = 0.0f, derivative_d = 0.0f, derivative_s = 0.0f;
    float dissimilarity = 0.0f;
    if (b >= MARGIN) {
        const int i = LANES * (b - MARGIN);
        const int windows = 3 * ((int)w - (TAPS - 1));
        global const floats *row = (global const floats *)moments + 4 * (size_t)blocks * y;
        const floats m_d = blur_along_x(row, i, 3);
        const floats m_s = blur_along_x(row + blocks, i, 3);
        const floats var_d = fmax(blur_along_x(row + 2 * blocks, i, 3) - m_d * m_d, 0.0f);
        const floats var_s = fmax(blur_along_x(row + 3 * blocks, i, 3) - m_s * m_s, 0.0f);
        const floats mean_s = m_s + SUM_SHIFT;
        const floats P = 0.5f * (m_d * m_d + mean_s * mean_s) + C1;
        const floats Q = 0.5f * (var_d + var_s) + C2;
        const floats a = m_d * m_d / P, b = var_d / Q;

        const float scale = 1.0f / ((float)windows * v);
        const ints inside = LANED(convert_int)(LANE) < windows - i;  // for select()
        dissimilarity = scale * SUM_LANES(select((floats)0.0f, a + b - a * b, inside));

        const floats dL_dvar_d = weight * scale * (1.0f - a) / Q * (1.0f - 0.5f * b);
        const floats dL_dvar_s = weight * scale * (1.0f - a) / Q * (-0.5f * b);
        const floats dL_dm = weight * scale * (1.0f - b) / P * ((2.0f - a) * m_d - a * mean_s);
        derivative_0 =
            select((floats)0.0f, dL_dm - 2.0f * (m_d * dL_dvar_d + m_s * dL_dvar_s), inside);
        derivative_d = select((floats)0.0f, 2.0f * dL_dvar_d, inside);
        derivative_s = select((floats)0.0f, 2.0f * dL_dvar_s, inside);
    }
    global floats *row = (global floats *)derivatives + 3 * (size_t)blocks * y + b;
    row[0] = derivative_0;
    row[blocks] = derivative_d;
    row[2 * blocks] = derivative_s;
    partial_terms[(size_t)blocks * y + b] =
        (float4)(weight * dissimilarity, 0.0f, dissimilarity, 0.0f);
}

// One work-item per LANES values of a row of windows: sums the derivatives of the 11 windows of the
// row that see each value.
kernel void loss_row_derivatives(
    const uint v,                     // rows of windows
    const uint blocks,                // vectors in a scratch row
    global const float *derivatives,  // (V, 3, BLOCKS, LANES)
    global float *row_derivatives)    // (V, 3, BLOCKS, LANES) without the last MARGIN blocks
{
    const int b = get_global_id(0), y = get_global_id(1);
    if (b + MARGIN >= blocks || y >= v) return;
    for (int f = 0; f < 3; f++) {
        const size_t row = ((size_t)y * 3 + f) * blocks;
        ((global floats *)row_derivatives)[row + b] =
            blur_along_x((global const floats *)derivatives + row, LANES * (b + MARGIN), -3);
    }
}

// One work-item per LANES values of a target row: sums the derivatives of the 11 rows of windows
// that see it, writes dL/dp and what the values give to the loss. Leaves the gradient outside the
// target as it is.
kernel void loss_gradient(
    const uint v,                         // rows of windows, 0 where there is no SSIM
    const uint h,                         // height of the target
    const uint w,                         // width of the target
    const uint pw,                        // width of the prediction
    const uint corner,                    // first value of the prediction under the target
    const uint blocks,                    // vectors in a scratch row
    const float beta,                     // of smooth L1
    global const float *prediction,       // (PH, PW, 3)
    global const float *target,           // (H, W, 3)
    global const float *row_derivatives,  // (V, 3, BLOCKS, LANES)
    global float *grad_prediction,        // (PH, PW, 3)
    global float4 *partial_terms)         // (ROWS, BLOCKS, 4) rows V to V + H - 1
{
    const int b = get_global_id(0), y = get_global_id(1);
    if (b >= blocks || y >= h) return;
    const int count = 3 * (int)w - LANES * b;
    float smooth = 0.0f, absolute = 0.0f, squared = 0.0f;
    if (count > 0) {
        const size_t at = corner + 3 * (size_t)pw * y + LANES * b;
        const floats p = load_lanes(prediction + at, count);
        const floats t = load_lanes(target + 3 * (size_t)w * y + LANES * b, count);
        const floats d = p - t, s = p + t - SUM_SHIFT;
        floats derivative_0 = 0.0f, derivative_d = 0.0f, derivative_s = 0.0f;
        for (int k = max(0, y - (int)v + 1); k < TAPS && k <= y; k++) {
            global const floats *row =
                (global const floats *)row_derivatives + 3 * (size_t)blocks * (y - k) + b;
            derivative_0 += WINDOW[k] * row[0];
            derivative_d += WINDOW[k] * row[blocks];
            derivative_s += WINDOW[k] * row[2 * blocks];
        }
        const float scale = 1.0f / (3.0f * h * w);
        const floats derivative =
            beta > 0.0f ? BOUNDED(d / beta, (floats)(-1.0f), (floats)(1.0f)) : sign(d);
        store_lanes(
            scale * derivative + derivative_0 + derivative_d * d + derivative_s * s,
            grad_prediction + at, count);
        smooth = scale * SUM_LANES(derivative * (d - 0.5f * beta * derivative));
        absolute = scale * SUM_LANES(fabs(d));
        squared = scale * SUM_LANES(d * d);
    }
    partial_terms[(size_t)blocks * (v + y) + b] = (float4)(smooth, absolute, 0.0f, squared);
}

// GROUP work-items per row: the sum of its terms.
kernel void loss_sum(
    const uint rows,
    const uint m,                // terms in a row
    global const float4 *terms,  // (ROWS, M, 4)
    global float4 *sums)         // (ROWS, 4)
{
    SHARED(float4, shared, GROUP);
    const size_t row = GROUP_ID;
    if (row >= rows) return;
    float4 sum = 0.0f;
    for (size_t i = MEMBER; i < m; i += GROUP)
        sum += terms[row * m + i];
    sum = group_sum4(sum, shared);
    if (MEMBER == 0) sums[row] = sum;
}

// GROUP work-items: write a further term, the scaled sum of the values, and ADD it, weighted, to
// the loss.
kernel void loss_add(
    const uint n,
    const uint term,  // which of the terms it is
    const float scale,
    const float weight,          // of the term in the loss
    global const float *values,  // (n)
    global float *terms)         // (?) the loss, and its terms
{
    SHARED(float, shared, GROUP);
    if (GROUP_ID > 0) return;
    float sum = 0.0f;
    for (uint i = MEMBER; i < n; i += GROUP)
        sum += values[i];
    sum = group_sum(sum, shared);
    if (MEMBER > 0) return;
    terms[term] = scale * sum;
    terms[0] += weight * (scale * sum);
}
