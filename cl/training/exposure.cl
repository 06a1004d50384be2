// Gains of the images, one a view and channel: what exposure and white balance multiplied them
// by. They are the least squares between what was rendered and the image over the last steps
// that saw a view, and the loss compares the rendering with the image divided by them. They
// concern the object's part of a colour over white, c - (1 - a).
#include "group.h"

#ifndef MOST
#define MOST 8.0f  // gain: three stops
#endif

// One work-item per target pixel: writes the image divided by its view's gains.
kernel void exposure_divide(
    const uint hw,  // pixels of the target
    const uint view,
    global const float4 *exposure,  // (VIEWS, 3, 4) the gain behind three others
    global const float *image,      // (H, W, 3)
    global const float *alpha,      // (H, W)
    global float *target)           // (H, W, 3)
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    global const float4 *channels = exposure + 3 * view;
    const float3 gain = (float3)(channels[0].w, channels[1].w, channels[2].w);
    const float white = 1.0f - alpha[q];
    vstore3((vload3(q, image) - white) / gain + white, q, target);
}

// GROUP work-items per row: write its sums of rendering times image, of the rendering squared
// and of the image squared.
kernel void exposure_products(
    const uint h,  // image
    const uint w,
    const uint pw,                   // width of the prediction
    const uint corner,               // first value of the prediction under the image
    global const float *prediction,  // (PH, PW, 3)
    global const float *image,       // (H, W, 3)
    global const float *alpha,       // (H, W)
    global float4 *row_products)     // (3, H, 4) the last unused
{
    SHARED(float4, shared, GROUP);
    const uint y = GROUP_ID;
    if (y >= h) return;
    float4 pt = 0.0f, pp = 0.0f, tt = 0.0f;
    for (uint x = MEMBER; x < w; x += GROUP) {
        const float a = alpha[y * w + x], white = 1.0f - a;
        const float3 p = vload3(x, prediction + corner + 3 * (size_t)pw * y) - white;
        const float3 t = vload3((size_t)y * w + x, image) - white;
        pt.xyz += a * p * t;
        pp.xyz += a * p * p;
        tt.xyz += a * t * t;
    }
    pt = group_sum4(pt, shared);
    pp = group_sum4(pp, shared);
    tt = group_sum4(tt, shared);
    if (MEMBER == 0) {
        row_products[y] = pt;
        row_products[h + y] = pp;
        row_products[2 * h + y] = tt;
    }
}

// One work-item per channel: sums the rows' products, adds the sums to those before of the view,
// which it lets fade, and writes the gains of all views. Their geometric mean is 1, as only what
// views differ by is known.
kernel void exposure_fit(
    const uint views,
    const uint view,
    const uint h,                      // rows
    const float decay,                 // of the sums before
    const float prior,                 // of a gain of 1, as a sum of squares
    global const float *row_products,  // (3, H, 4)
    global float4 *exposure)           // (VIEWS, 3, 4) the sums of three products, and the gain
{
    const uint c = get_global_id(0);
    if (c >= 3) return;
    float3 products = 0.0f;
    for (uint y = 0; y < h; y++)
        products += (float3)(row_products[4 * y + c], row_products[4 * (h + y) + c],
                             row_products[4 * (2 * h + y) + c]);
    float sum = 0.0f;
    for (uint v = 0; v < views; v++) {
        global float4 *channel = exposure + 3 * v + c;
        float4 known = *channel;
        if (v == view) known.xyz = decay * known.xyz + products;
        const float gain = (known.x + prior) / (known.y + prior);
        known.w = BOUNDED(gain, 1.0f / MOST, MOST);
        sum += log(known.w);
        *channel = known;
    }
    const float mean = exp(sum / views);
    for (uint v = 0; v < views; v++)
        exposure[3 * v + c].w /= mean;
}
