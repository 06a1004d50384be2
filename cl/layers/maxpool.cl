// Max pooling, on (H, W, C) feature maps: of the network of LPIPS. A work-item is (LANES channels, x,
// y): one vector of a pixel, shorter at the last channels.
#include "common.h"
#include "lanes.h"

// The larger of two values in each lane, NaN where one of them is; fmax() would hide it.
static inline floats larger(const floats a, const floats b) {
    return select(b, a, (a >= b) | (a != a));
}

// One work-item per (LANES channels, x, y) of out: reads the 2x2 pixels it covers, writes their
// largest; an odd last row or column of x is left out, as PyTorch does.
kernel void maxpool2_forward(
    const int h,  // of out
    const int w,
    const int c,
    const int x_width,
    global const float *x,  // (?, x_width, c)
    global float *out)      // (h, w, c)
{
    const int first = get_global_id(0) * LANES, column = get_global_id(1), row = get_global_id(2),
              count = c - first;
    if (first >= c || column >= w || row >= h) return;
    global const float *upper = x + ((size_t)row * 2 * x_width + column * 2) * c + first,
                       *lower = upper + x_width * c;
    const floats largest = larger(
        larger(load_lanes(upper, count), load_lanes(upper + c, count)),
        larger(load_lanes(lower, count), load_lanes(lower + c, count)));
    store_lanes(largest, out + ((size_t)row * w + column) * c + first, count);
}
