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
// The mask term is weight * mean of (a - m)^2 of the rendered alpha a = 1 - T and the image's alpha
// m. Where a < m it counts `shortfall` times, which rises from 0 to 1 in the course of a training:
// at first it would hold the points of the hull that lie in front of the surface. Without it the
// points reach half a spacing beyond the outline, where the network paints them white, and white
// parts of the object stay transparent.
//
// The kernels run in their order here. Scratch rows are BLOCKS vectors of LANES values long, MARGIN
// more than 3W values need, so that no tap along x needs a test. The terms stay sums of rows, which
// the host adds up.
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

// LANES values of a scratch row blurred from value i on; each tap lies `step` values beside the one
// before.
static inline floats blur_along_x(global const floats *row, const int i, const int step) {
    global const float *values = (global const float *)row + i;
    floats sum = 0.0f;
    for (int k = 0; k < TAPS; k++)
        sum += WINDOW[k] * LANES_FROM(values + step * k);
    return sum;
}

// GROUP work-items per row of windows, LANES values at a time: the moments of d, s, d^2, s^2 along
// y, then along x; write the sum of 1 - SSIM, and the derivatives summed along x, of which dL/dp of
// a pixel is the window-weighted sum over y of [0] + [1] d + [2] s.
kernel void loss_windows(
    const uint v,                    // rows of windows, H - 10
    const uint w,                    // width of the target
    const uint pw,                   // width of the prediction
    const uint corner,               // first value of the prediction under the target
    const uint blocks,               // vectors in a scratch row
    const float weight,              // of 1 - SSIM
    global const float *prediction,  // (PH, PW, 3)
    global const float *target,      // (H, W, 3)
    global float *moments,           // (V, 4, BLOCKS, LANES)
    global float *derivatives,       // (V, 3, BLOCKS, LANES) 0 outside the windows
    global float *row_derivatives,   // (V, 3, BLOCKS, LANES) without the last MARGIN blocks
    global float4 *terms)            // (?, 4) rows 0 to V - 1: mean of 1 - SSIM, a row's share; 0
{
    SHARED(float, shared, GROUP);
    const uint y = GROUP_ID;
    if (y >= v) return;
    global floats *moment = (global floats *)moments + 4 * (size_t)blocks * y;
    for (uint b = MEMBER; b < blocks; b += GROUP) {
        const int count = 3 * (int)w - LANES * (int)b;
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
        moment[b] = m_d;
        moment[blocks + b] = m_s;
        moment[2 * blocks + b] = m_dd;
        moment[3 * blocks + b] = m_ss;
    }
    GROUP_BARRIER
    // shifted right by MARGIN
    const int windows = 3 * ((int)w - (TAPS - 1));
    const float scale = 1.0f / ((float)windows * v);
    global floats *derivative = (global floats *)derivatives + 3 * (size_t)blocks * y;
    float dissimilarity = 0.0f;
    for (uint b = MEMBER; b < blocks; b += GROUP) {
        floats derivative_0 = 0.0f, derivative_d = 0.0f, derivative_s = 0.0f;
        if (b >= MARGIN) {
            const int i = LANES * (b - MARGIN);
            const floats m_d = blur_along_x(moment, i, 3);
            const floats m_s = blur_along_x(moment + blocks, i, 3);
            const floats var_d = fmax(blur_along_x(moment + 2 * blocks, i, 3) - m_d * m_d, 0.0f);
            const floats var_s = fmax(blur_along_x(moment + 3 * blocks, i, 3) - m_s * m_s, 0.0f);
            const floats mean_s = m_s + SUM_SHIFT;
            const floats P = 0.5f * (m_d * m_d + mean_s * mean_s) + C1;
            const floats Q = 0.5f * (var_d + var_s) + C2;
            const floats a = m_d * m_d / P, b = var_d / Q;

            const ints inside = LANED(convert_int)(LANE) < windows - i;  // for select()
            dissimilarity += scale * SUM_LANES(select((floats)0.0f, a + b - a * b, inside));

            const floats dL_dvar_d = weight * scale * (1.0f - a) / Q * (1.0f - 0.5f * b);
            const floats dL_dvar_s = weight * scale * (1.0f - a) / Q * (-0.5f * b);
            const floats dL_dm = weight * scale * (1.0f - b) / P * ((2.0f - a) * m_d - a * mean_s);
            derivative_0 =
                select((floats)0.0f, dL_dm - 2.0f * (m_d * dL_dvar_d + m_s * dL_dvar_s), inside);
            derivative_d = select((floats)0.0f, 2.0f * dL_dvar_d, inside);
            derivative_s = select((floats)0.0f, 2.0f * dL_dvar_s, inside);
        }
        derivative[b] = derivative_0;
        derivative[blocks + b] = derivative_d;
        derivative[2 * blocks + b] = derivative_s;
    }
    GROUP_BARRIER
    global floats *sums = (global floats *)row_derivatives + 3 * (size_t)blocks * y;
    for (uint b = MEMBER; b + MARGIN < blocks; b += GROUP)
        for (uint f = 0; f < 3; f++)
            sums[f * blocks + b] = blur_along_x(derivative + f * blocks, LANES * (b + MARGIN), -3);
    dissimilarity = group_sum(dissimilarity, shared);
    if (MEMBER == 0) terms[y] = (float4)(dissimilarity, 0.0f, 0.0f, 0.0f);
}

// GROUP work-items per row of the prediction: sum the derivatives of the 11 rows of windows that see
// it, write dL/dp and with has_mask dL/da, both 0 outside the target, and what the row gives to the
// loss.
kernel void loss_gradient(
    const uint v,         // rows of windows, 0 where there is no SSIM
    const uint h,         // target
    const uint w,         //
    const uint ph,        // prediction
    const uint pw,        //
    const uint left,      // of the target in it
    const uint top,       //
    const uint blocks,    // vectors in a scratch row
    const float beta,     // of smooth L1
    const uint has_mask,  // of what follows, else nothing of the mask is read or written
    const float mask_weight,
    const float shortfall,
    global const float *prediction,       // (PH, PW, 3)
    global const float *target,           // (H, W, 3)
    global const float *row_derivatives,  // (V, 3, BLOCKS, LANES)
    global const float *transmittance,    // (...) (PH * PW) T, NULL without has_mask
    global const float *target_alpha,     // (...) (H, W) m, below 0 where it is ignored, or NULL
    global float *grad_prediction,        // (PH, PW, 3)
    global float *grad_alpha,             // (...) (PH * PW)
    global float4 *terms)  // (?, 4) rows V to V + PH - 1: shares of the means of smooth L1, |d| and
                           // d^2, the sum of the mask's squares
{
    SHARED(float4, shared, GROUP);
    const uint row = GROUP_ID;
    if (row >= ph) return;
    const uint y = row - top;  // of the target
    const bool inside = row >= top && y < h;
    const uint begin = inside ? 3 * left : 3 * pw, end = begin + 3 * w;
    global float *grad = grad_prediction + 3 * (size_t)pw * row;
    for (uint i = MEMBER; i < 3 * pw; i += GROUP)
        if (i < begin || i >= end) grad[i] = 0.0f;
    float4 sum = 0.0f;
    const float scale = 1.0f / (3.0f * h * w);
    for (uint b = MEMBER; inside && LANES * b < 3 * w; b += GROUP) {
        const int count = 3 * w - LANES * b;
        const floats p = load_lanes(prediction + 3 * (size_t)pw * row + begin + LANES * b, count);
        const floats t = load_lanes(target + 3 * (size_t)w * y + LANES * b, count);
        const floats d = p - t, s = p + t - SUM_SHIFT;
        floats derivative_0 = 0.0f, derivative_d = 0.0f, derivative_s = 0.0f;
        for (int k = max(0, (int)y - (int)v + 1); k < TAPS && k <= (int)y; k++) {
            global const floats *sums =
                (global const floats *)row_derivatives + 3 * (size_t)blocks * (y - k) + b;
            derivative_0 += WINDOW[k] * sums[0];
            derivative_d += WINDOW[k] * sums[blocks];
            derivative_s += WINDOW[k] * sums[2 * blocks];
        }
        const floats derivative =
            beta > 0.0f ? BOUNDED(d / beta, (floats)(-1.0f), (floats)(1.0f)) : sign(d);
        store_lanes(
            scale * derivative + derivative_0 + derivative_d * d + derivative_s * s,
            grad + begin + LANES * b, count);
        sum += scale * (float4)(SUM_LANES(derivative * (d - 0.5f * beta * derivative)),
                                SUM_LANES(fabs(d)), SUM_LANES(d * d), 0.0f);
    }
    const float mask_scale = 2.0f * mask_weight / ((float)h * w);
    for (uint x = MEMBER; has_mask && x < pw; x += GROUP) {
        const uint q = row * pw + x;
        float m = -1.0f;
        if (inside && x >= left && x < left + w) m = target_alpha[y * w + x - left];
        const float difference = m < 0.0f ? 0.0f : 1.0f - transmittance[q] - m;
        const float weighted = difference < 0.0f ? shortfall * difference : difference;
        grad_alpha[q] = mask_scale * weighted;
        sum.w += weighted * difference;
    }
    sum = group_sum4(sum, shared);
    if (MEMBER == 0) terms[v + row] = sum;
}
