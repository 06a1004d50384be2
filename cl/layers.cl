// The layers between convolutions, on (H, W, C) feature maps: pooling, bilinear upsampling, a straight line.
// In all of them the first global index is the channel: neighbouring work-items touch neighbouring floats.

// One work-item per (channel, x, y) of out: reads the 2x2 pixels it covers, writes their mean.
kernel void avgpool2_forward(
    const int h,                         // of out
    const int w,
    const int c,
    global const float *x,               // (?, ?, c) twice the height and width of out
    global float *out)                   // (h, w, c)
{
    const int i = get_global_id(0), column = get_global_id(1), row = get_global_id(2);
    if (i >= c || column >= w || row >= h)
        return;
    const size_t stride = (size_t)2 * w * c, at = 2 * row * stride + 2 * column * c + i;
    out[((size_t)row * w + column) * c + i] = 0.25f * ((x[at] + x[at + c]) + (x[at + stride] + x[at + stride + c]));
}

// One work-item per (channel, x, y) of x: ADDS its share of grad_out to grad_x, which holds the gradient from x's other
// use, and then sets it to 0 where x <= 0: x is the output of a ReLU, grad_x becomes the gradient of that ReLU's input.
kernel void avgpool2_backward(
    const int h,                         // of out
    const int w,
    const int c,
    global const float *x,               // (?, ?, c)
    global const float *grad_out,        // (h, w, c)
    global float *grad_x)                // (?, ?, c)
{
    const int i = get_global_id(0), column = get_global_id(1), row = get_global_id(2);
    if (i >= c || column >= 2 * w || row >= 2 * h)
        return;
    const size_t at = ((size_t)row * 2 * w + column) * c + i;
    const float dL_dx = grad_x[at] + 0.25f * grad_out[((size_t)(row / 2) * w + column / 2) * c + i];
    grad_x[at] = x[at] > 0.0f ? dL_dx : 0.0f;
}

// One work-item per (channel, x, y) of out: reads the 2x2 pixels it covers, writes their largest; an odd last row or column
// of x is left out, as PyTorch does.
kernel void maxpool2_forward(
    const int h,                         // of out
    const int w,
    const int c,
    const int x_width,
    global const float *x,               // (?, x_width, c)
    global float *out)                   // (h, w, c)
{
    const int i = get_global_id(0), column = get_global_id(1), row = get_global_id(2);
    if (i >= c || column >= w || row >= h)
        return;
    const size_t stride = (size_t)x_width * c, at = 2 * row * stride + 2 * column * c + i;
    out[((size_t)row * w + column) * c + i] = fmax(fmax(x[at], x[at + c]), fmax(x[at + stride], x[at + stride + c]));
}

// One work-item per (channel, x, y) of out, which is twice as high and wide as x: reads the nearest pixel and its
// neighbours towards out's centre, writes them weighted 3/4 and 1/4 along each axis (bilinear, align_corners False, the
// border repeated).
kernel void upsample2_forward(
    const int h,                         // of x
    const int w,
    const int c,
    global const float *x,               // (h, w, c)
    global float *out)                   // (?, ?, c)
{
    const int i = get_global_id(0), column = get_global_id(1), row = get_global_id(2);
    if (i >= c || column >= 2 * w || row >= 2 * h)
        return;
    const int x0 = column / 2, x1 = clamp(x0 - 1 + 2 * (column & 1), 0, w - 1);
    const int y0 = row / 2, y1 = clamp(y0 - 1 + 2 * (row & 1), 0, h - 1);
    global const float *near = x + (size_t)y0 * w * c + i, *far = x + (size_t)y1 * w * c + i;
    out[((size_t)row * 2 * w + column) * c + i] = 0.75f * (0.75f * near[x0 * c] + 0.25f * near[x1 * c])
                                                + 0.25f * (0.75f * far[x0 * c] + 0.25f * far[x1 * c]);
}

// One work-item per (channel, x, y) of x: gathers the 4x4 pixels of grad_out that read it, writes their weighted sum.
kernel void upsample2_backward(
    const int h,                         // of x
    const int w,
    const int c,
    global const float *grad_out,        // (?, ?, c) twice the height and width of x
    global float *grad_x)                // (h, w, c)
{
    const int i = get_global_id(0), column = get_global_id(1), row = get_global_id(2);
    if (i >= c || column >= w || row >= h)
        return;
    const float tap[4] = {0.25f, 0.75f, 0.75f, 0.25f};
    float dL_dx = 0.0f;
    // Rows and columns outside out are, in the repeated border, a quarter more of the row or column that is its edge.
    for (int dy = 0; dy < 4; dy++) {
        const int y = clamp(2 * row - 1 + dy, 0, 2 * h - 1);
        global const float *grad = grad_out + (size_t)y * 2 * w * c + i;
        float sum = 0.0f;
        for (int dx = 0; dx < 4; dx++)
            sum += tap[dx] * grad[clamp(2 * column - 1 + dx, 0, 2 * w - 1) * c];
        dL_dx += tap[dy] * sum;
    }
    grad_x[((size_t)row * w + column) * c + i] = dL_dx;
}

// One work-item per element: reads x, writes scale * x + offset.
kernel void affine(
    const uint n,
    const float scale,
    const float offset,
    global const float *x,               // (...)
    global float *out)                   // (...)
{
    const uint i = get_global_id(0);
    if (i >= n)
        return;
    out[i] = scale * x[i] + offset;
}
