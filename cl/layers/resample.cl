// The layers between convolutions, on (H, W, C) feature maps: mean pooling, bilinear upsampling. A
// work-item is (LANES channels, x, y): one vector of a pixel, shorter at the last channels. It
// writes where its tile is computed (tiles.h).
#include "common.h"
#include "lanes.h"
#include "layers/tiles.h"

// One work-item per (LANES channels, x, y) of out: reads the 2x2 pixels it covers, writes their
// mean.
kernel void avgpool2_forward(
    const int h,  // of out
    const int w,
    const int c,
    global const float *x,           // (2*h, 2*w, c)
    global const float *tile_count,  // ((h+3)/4, (w+3)/4) of out, 0 = not computed
    global float *out)               // (h, w, c)
{
    const int first = get_global_id(0) * LANES, column = get_global_id(1), row = get_global_id(2),
              count = c - first;
    if (first >= c || column >= w || row >= h || !tile_is_computed(tile_count, column, row, w))
        return;
    global const float *upper = x + ((size_t)row * 4 * w + column * 2) * c + first,
                       *lower = upper + 2 * w * c;
    const floats sum = (load_lanes(upper, count) + load_lanes(upper + c, count)) +
                       (load_lanes(lower, count) + load_lanes(lower + c, count));
    store_lanes(0.25f * sum, out + ((size_t)row * w + column) * c + first, count);
}

// One work-item per (LANES channels, x, y) of x: ADDS its share of grad_out to grad_x, which holds
// the gradient from x's other use. If masked, it then sets it to 0 where x <= 0: x is the output of
// a ReLU, grad_x becomes the gradient of that ReLU's input.
kernel void avgpool2_backward(
    const int h,  // of out
    const int w,
    const int c,
    const int masked,
    global const float *x,           // (2*h, 2*w, c) NULL if not masked
    global const float *grad_out,    // (h, w, c)
    global const float *tile_count,  // ((2*h+3)/4, (2*w+3)/4) of grad_x, 0 = not computed
    global float *grad_x)            // (2*h, 2*w, c)
{
    const int first = get_global_id(0) * LANES, column = get_global_id(1), row = get_global_id(2),
              count = c - first;
    if (first >= c || column >= 2 * w || row >= 2 * h ||
        !tile_is_computed(tile_count, column, row, 2 * w))
        return;
    const size_t at = ((size_t)row * 2 * w + column) * c + first;
    const floats dL_dout =
        load_lanes(grad_out + ((size_t)(row / 2) * w + column / 2) * c + first, count);
    floats dL_dx = load_lanes(grad_x + at, count) + 0.25f * dL_dout;
    if (masked) dL_dx = select((floats)0.0f, dL_dx, load_lanes(x + at, count) > 0.0f);
    store_lanes(dL_dx, grad_x + at, count);
}

// One work-item per (LANES channels, x, y) of x: writes the 2x2 pixels of out, which is twice as
// high and wide, that lie in its pixel, and all of them in one tile. Each is the pixel of x that
// its centre lies in and the nearest ones beside it, weighted 3/4 and 1/4 along each axis
// (bilinear, align_corners False, the border repeated).
kernel void upsample2_forward(
    const int h,  // of x
    const int w,
    const int c,
    global const float *x,           // (h, w, c)
    global const float *tile_count,  // ((2*h+3)/4, (2*w+3)/4) of out, 0 = not computed
    global float *out)               // (2*h, 2*w, c)
{
    const int first = get_global_id(0) * LANES, column = get_global_id(1), row = get_global_id(2),
              count = c - first;
    if (first >= c || column >= w || row >= h ||
        !tile_is_computed(tile_count, 2 * column, 2 * row, 2 * w))
        return;
    const int left = max(column - 1, 0) * c, right = min(column + 1, w - 1) * c;
    floats line[3][2];  // rows row - 1, row, row + 1 of x at the two columns of out
    UNROLLED_FOR (int i = 0; i < 3; i++) {
        global const float *pixels = x + (size_t)clamp(row - 1 + i, 0, h - 1) * w * c + first;
        const floats near = 0.75f * load_lanes(pixels + column * c, count);
        line[i][0] = near + 0.25f * load_lanes(pixels + left, count);
        line[i][1] = near + 0.25f * load_lanes(pixels + right, count);
    }
    global float *corner = out + ((size_t)row * 4 * w + column * 2) * c + first;
    UNROLLED_FOR (int i = 0; i < 4; i++)
        store_lanes(
            0.75f * line[1][i % 2] + 0.25f * line[i / 2 * 2][i % 2],
            corner + (i / 2 * 2 * w + i % 2) * c, count);
}

// One work-item per (LANES channels, x, y) of x: gathers the 4x4 pixels of grad_out that read it,
// writes their weighted sum.
kernel void upsample2_backward(
    const int h,  // of x
    const int w,
    const int c,
    global const float *grad_out,    // (2*h, 2*w, c)
    global const float *tile_count,  // ((h+3)/4, (w+3)/4) of grad_x, 0 = not computed
    global float *grad_x)            // (h, w, c)
{
    const int first = get_global_id(0) * LANES, column = get_global_id(1), row = get_global_id(2),
              count = c - first;
    if (first >= c || column >= w || row >= h || !tile_is_computed(tile_count, column, row, w))
        return;
    // The outermost row or column reads its own edge of x with weight 1: it counts once more in
    // place of the one outside.
    const int x0 = max(2 * column - 1, 0) * c, x1 = 2 * column * c, x2 = x1 + c,
              x3 = min(2 * column + 2, 2 * w - 1) * c;
    floats dL_dx = 0.0f;
    UNROLLED_FOR (int dy = 0; dy < 4; dy++) {
        const int y = clamp(2 * row - 1 + dy, 0, 2 * h - 1);
        global const float *grad = grad_out + (size_t)y * 2 * w * c + first;
        const floats outer = load_lanes(grad + x0, count) + load_lanes(grad + x3, count);
        const floats inner = load_lanes(grad + x1, count) + load_lanes(grad + x2, count);
        dL_dx += (dy == 0 || dy == 3 ? 0.25f : 0.75f) * (0.25f * outer + 0.75f * inner);
    }
    store_lanes(dL_dx, grad_x + ((size_t)row * w + column) * c + first, count);
}
