// The colours of a view: the matrix that its image is the model's rendering times, by exposure and
// white balance a gain of each channel, by a camera's other treatment any 3x4 matrix. They are the
// least squares between what was rendered and the image over the last steps that saw the view, and
// the loss compares the rendering with the image that has been multiplied by the inverse. They
// concern the object's part of a colour over white, c - (1 - a), and a itself, the fourth column's.
#include "group.h"
#include "training/exposure.h"

#ifndef MOST
#define MOST 8.0f  // gain: three stops
#endif
#define BLOCK 8  // pixels of the squares that are one half of the image and the other in turn

// GROUP work-items per row: write its sums of products, of both halves.
kernel void exposure_products(
    const uint h,  // image
    const uint w,
    const uint pw,                   // width of the prediction
    const uint corner,               // first value of the prediction under the image
    global const float *prediction,  // (PH, PW, 3)
    global const float *image,       // (H, W, 3)
    global const float *alpha,       // (H, W)
    global float4 *row_products)     // (H, MATRIX, 4)
{
    SHARED(float4, shared, GROUP);
    const uint y = GROUP_ID;
    if (y >= h) return;
    for (uint half_of = 0; half_of < 2; half_of++) {
        float4 sums[SUMS];
        for (uint k = 0; k < SUMS; k++)
            sums[k] = 0.0f;
        for (uint x = MEMBER; x < w; x += GROUP) {
            if ((x / BLOCK + y / BLOCK) % 2 != half_of) continue;
            const float a = alpha[y * w + x], white = 1.0f - a;
            const float4 p =
                (float4)(vload3(x, prediction + corner + 3 * (size_t)pw * y) - white, a);
            const float3 t = vload3((size_t)y * w + x, image) - white;
            sums[0] += a * p.x * p;
            sums[1] += a * p.y * p;
            sums[2] += a * p.z * p;
            sums[3] += a * p.w * p;
            sums[4] += a * t.x * p;
            sums[5] += a * t.y * p;
            sums[6] += a * t.z * p;
            sums[7].xyz += a * t * t;
        }
        for (uint k = 0; k < SUMS; k++) {
            const float4 sum = group_sum4(sums[k], shared);
            if (MEMBER == 0) row_products[MATRIX * y + SUMS * half_of + k] = sum;
        }
    }
}

// One work-item per row of the sums: adds those of an image to those before of its view, which it
// lets fade.
kernel void exposure_sum(
    const uint view,
    const uint h,                       // rows of the image
    const float decay,                  // of the sums before
    global const float4 *row_products,  // (H, MATRIX, 4)
    global float4 *exposure)            // (VIEWS, ROWS, 4)
{
    const uint k = get_global_id(0);
    if (k >= MATRIX) return;
    float4 sum = 0.0f;
    for (uint y = 0; y < h; y++)
        sum += row_products[MATRIX * y + k];
    exposure[ROWS * view + k] = decay * exposure[ROWS * view + k] + sum;
}

// One work-item per view: writes the matrix by which its rendering is nearest to its image, drawn
// towards the identity.
kernel void exposure_solve(
    const uint views,
    const int is_full,        // or a gain of each channel alone
    const float prior,        // of the identity, as a sum of squares
    global float4 *exposure)  // (VIEWS, ROWS, 4)
{
    const uint view = get_global_id(0);
    if (view >= views) return;
    global float4 *sums = exposure + ROWS * view;
    float a[4][4], b[3][4];
    for (uint i = 0; i < 4; i++)
        vstore4(sums[i] + sums[SUMS + i], 0, a[i]);
    for (uint c = 0; c < 3; c++)
        vstore4(sums[4 + c] + sums[SUMS + 4 + c], 0, b[c]);
    for (uint c = 0; c < 3; c++)
        b[c][c] += prior;
    for (uint i = 0; i < 4; i++)
        a[i][i] += prior;
    // a = L L^T in place of its lower triangle
    for (uint i = 0; is_full && i < 4; i++)
        for (uint j = 0; j <= i; j++) {
            float left = a[i][j];
            for (uint k = 0; k < j; k++)
                left -= a[i][k] * a[j][k];
            // rounding may leave less than what the prior has added
            a[i][j] = i == j ? sqrt(fmax(left, 0.5f * prior)) : left / a[j][j];
        }
    for (uint c = 0; c < 3; c++) {
        float m[4] = {0.0f, 0.0f, 0.0f, 0.0f};
        if (!is_full) {
            const float gain = b[c][c] / a[c][c];
            m[c] = BOUNDED(gain, 1.0f / MOST, MOST);
        }
        for (uint i = 0; is_full && i < 4; i++) {
            m[i] = b[c][i];
            for (uint k = 0; k < i; k++)
                m[i] -= a[i][k] * m[k];
            m[i] /= a[i][i];
        }
        for (int i = 3; is_full && i >= 0; i--) {
            for (int k = i + 1; k < 4; k++)
                m[i] -= a[k][i] * m[k];
            m[i] /= a[i][i];
        }
        sums[MATRIX + c] = vload4(0, m);
    }
}

// One work-item: multiplies the views' matrices by the inverse of their mean, as only what views
// differ by is known.
kernel void exposure_centre(
    const uint views,
    global float4 *exposure)  // (VIEWS, ROWS, 4)
{
    if (get_global_id(0) > 0) return;
    float4 r = 0.0f, g = 0.0f, b = 0.0f;
    for (uint v = 0; v < views; v++) {
        r += exposure[ROWS * v + MATRIX] / views;
        g += exposure[ROWS * v + MATRIX + 1] / views;
        b += exposure[ROWS * v + MATRIX + 2] / views;
    }
    // columns of the inverse
    const float3 gb = cross(g.xyz, b.xyz), br = cross(b.xyz, r.xyz), rg = cross(r.xyz, g.xyz);
    const float volume = dot(r.xyz, gb);
    const float3 x = gb / volume, y = br / volume, z = rg / volume;
    const float3 shift = r.w * x + g.w * y + b.w * z;
    for (uint row = 0; row < 3 * views; row++) {
        global float4 *m = exposure + ROWS * (row / 3) + MATRIX + row % 3;
        const float3 old = (*m).xyz;
        *m = (float4)(dot(old, x), dot(old, y), dot(old, z), (*m).w - dot(old, shift));
    }
}
