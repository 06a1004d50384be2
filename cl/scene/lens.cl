// An image freed of its lens distortion, and reduced by area in the same pass: a cubic B-spline
// through its premultiplied pixels (Unser 1991), whose edge goes on outside of the image, is read
// where the lens puts the samples of a pinhole camera.
#include "common.h"

#define POLE -0.26794919f  // sqrt(3) - 2, of the recursion that makes a spline's coefficients
#define SCALE 6.0f         // of both of its directions
#define MARGIN 8  // coefficients on either side of the image; further out they are constant

static inline float4 premultiplied(const uchar4 pixel) {
    const float4 c = convert_float4(pixel) / 255.0f;
    return (float4)(c.xyz * c.w, c.w);
}

// One work-item per row: reads it as the image has it, writes its spline's coefficients.
kernel void lens_spline_rows(
    const int width,
    const int rows,        // of the coefficients: a band, which may reach outside of the image
    const int first,       // row of the image that is the band's first
    const int image_rows,  // of the part of the image that is there
    global const uchar4 *image,   // (image_rows, width, 4) straight RGBA
    global float4 *coefficients)  // (rows, width + 16, 4)
{
    const int y = get_global_id(0), last = width + 2 * MARGIN - 1;
    if (y >= rows) return;
    global const uchar4 *line = image + (size_t)clamp(first + y, 0, image_rows - 1) * width;
    global float4 *out = coefficients + (size_t)y * (last + 1);
    float4 c = premultiplied(line[0]) / (1.0f - POLE);  // as if its edge had gone on for ever
    for (int x = 0; x <= last; x++)
        out[x] = c = premultiplied(line[clamp(x - MARGIN, 0, width - 1)]) + POLE * c;
    c *= -POLE / (1.0f - POLE);
    for (int x = last; x >= 0; x--) {
        c = POLE * (c - out[x]);
        out[x] = SCALE * c;
    }
}

// One work-item per column of the coefficients: the same along it, in place.
kernel void lens_spline_columns(
    const int columns,
    const int rows,
    global float4 *coefficients)  // (rows, columns, 4)
{
    const int x = get_global_id(0);
    if (x >= columns) return;
    global float4 *at = coefficients + x;
    float4 c = at[0] / (1.0f - POLE);
    for (int y = 0; y < rows; y++, at += columns)
        *at = c = *at + POLE * c;
    c *= -POLE / (1.0f - POLE);
    for (int y = 0; y < rows; y++) {
        at -= columns;
        c = POLE * (c - *at);
        *at = SCALE * c;
    }
}

// Where the lens puts the point (x / z, y / z): OpenCV's models, as LensDistortion.apply has them.
// lens: fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, and whether it is a fisheye.
static inline float2 distorted(global const float *lens, const float x, const float y) {
    const float k1 = lens[4], k2 = lens[5], p1 = lens[6], p2 = lens[7], k3 = lens[8];
    const float xx = x * x, yy = y * y, xy = x * y, r2 = xx + yy;
    if (lens[12] != 0.0f) {
        const float r = fmax(sqrt(r2), 1e-12f), t = atan(r), t2 = t * t;
        return (float2)(x, y) * (t / r) * (1.0f + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * lens[9]))));
    }
    const float radial = (1.0f + r2 * (k1 + r2 * (k2 + r2 * k3))) /
                         (1.0f + r2 * (lens[9] + r2 * (lens[10] + r2 * lens[11])));
    return (float2)(x * radial + 2.0f * p1 * xy + p2 * (r2 + 2.0f * xx),
                    y * radial + p1 * (r2 + 2.0f * yy) + 2.0f * p2 * xy);
}

// Weights of the four coefficients around a place that lies t in [0, 1) behind the second.
static inline float4 spline(const float t) {
    const float s = 1.0f - t, t2 = t * t, s2 = s * s;
    return (float4)(s2 * s, 4.0f - 3.0f * t2 * (1.0f + s), 4.0f - 3.0f * s2 * (1.0f + t), t2 * t) /
           6.0f;
}

// One work-item per pixel of the result: reads factor x factor places of the spline, writes their
// mean as straight RGBA.
kernel void lens_undistort(
    const int width,  // of the band of the result
    const int height,
    const int top,     // row of the result that is the band's first
    const int factor,  // samples of a pixel, each way
    const int columns,
    const int rows,
    const int first,                    // row of the image whose coefficients are the first
    global const float *lens,           // (13)
    global const float4 *coefficients,  // (rows, columns, 4)
    global uchar4 *image)               // (height, width, 4)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    float4 sum = 0.0f;
    for (int v = 0; v < factor; v++)
        for (int u = 0; u < factor; u++) {
            const float2 at = distorted(
                lens, (x * factor + u + 0.5f - lens[2]) / lens[0],
                ((y + top) * factor + v + 0.5f - lens[3]) / lens[1]);
            // in coefficients, of which four must be there each way
            const float column =
                clamp(lens[0] * at.x + lens[2] - 0.5f + MARGIN, 1.0f, columns - 2.5f);
            const float row = clamp(lens[1] * at.y + lens[3] - 0.5f - first, 1.0f, rows - 2.5f);
            const int left = (int)column - 1, above = (int)row - 1;
            const float4 across = spline(column - (left + 1)), down = spline(row - (above + 1));
            global const float4 *c = coefficients + (size_t)above * columns + left;
            float4 value = 0.0f;
            const float weights[4] = {down.x, down.y, down.z, down.w};
            for (int i = 0; i < 4; i++, c += columns)
                value += weights[i] *
                         (across.x * c[0] + across.y * c[1] + across.z * c[2] + across.w * c[3]);
            // what overshoots beside a mask's border keeps its colour
            sum += clamp(value / fmax(value.w, 1.0f), 0.0f, 1.0f);
        }
    const float4 mean = sum / (float)(factor * factor);
    const float4 straight = (float4)(fmin(mean.xyz / fmax(mean.w, 1e-3f), 1.0f), mean.w);
    image[y * width + x] = convert_uchar4(straight * 255.0f + 0.5f);
}
