// Direct 3x3 convolution through local memory, for GPUs: the kernels of conv.cl with the same
// arguments and results, for channels in multiples of 16.
//
// A work-group of ITEMS computes ROWS x COLUMNS pixels of 32 output channels. CHUNK input channels
// at a time, it brings the pixels' neighbourhood and the weights to local memory, from where each
// item takes what it needs for SPAN neighbouring pixels of 8 output channels: SPAN + 2 values and 3
// x 8 weights for 3 x 8 x SPAN multiply-adds. Items that follow each other take other pixels and
// the same channels, so that reading weights is one broadcast.
//
// Barriers stand in loops whose bounds are the same for all items.
#include "common.h"
#include "layers/tiles.h"

#define ITEMS 128  // (ROWS * COLUMNS / SPAN) groups of pixels x 4 groups of 8 channels
#define ROWS 8
#define COLUMNS 16
#define SPAN 4   // 4 x 8 accumulators leave room for two work-groups among an SM's registers
#define CHUNK 8  // 15 KiB of local memory, half of what the smallest GPUs have; divides 16
#define PITCH (COLUMNS + 2)
#define VALUES ((ROWS + 2) * PITCH)  // of one input channel

// Bring channels c0 .. c0 + CHUNK - 1 of the neighbourhood of the pixels from (x0, y0) on to
// values[channel][row][column]; zero where there is no pixel.
static inline void load_values(
    local float *values,
    global const float *x,
    const int channels,
    const int c0,
    const int x0,
    const int y0,
    const int height,
    const int width) {
    for (int i = get_local_id(0); i < VALUES * CHUNK; i += ITEMS) {
        const int c = i % CHUNK, pixel = i / CHUNK;
        const int px = x0 + pixel % PITCH - 1, py = y0 + pixel / PITCH - 1;
        const bool inside = px >= 0 && px < width && py >= 0 && py < height;
        values[c * VALUES + pixel] =
            inside ? x[((size_t)py * width + px) * channels + c0 + c] : 0.0f;
    }
}

// Bring the weights of those input channels and 32 output channels to weights[channel][tap][output
// channel]; zero where there is no output channel. weight: of the first of `blocks` blocks of 16
// output channels and of x's first channel, ci of which make a row.
static inline void load_weights(
    local float *weights,
    global const float *weight,
    const int blocks,
    const int ci,
    const int c0) {
    for (int i = get_local_id(0); i < CHUNK * 9 * 32; i += ITEMS) {
        const int lane = i % 16, c = i / 16 % CHUNK, tap = i / (16 * CHUNK) % 9,
                  block = i / (16 * CHUNK * 9);
        weights[(c * 9 + tap) * 32 + block * 16 + lane] =
            block < blocks ? weight[((block * 9 + tap) * ci + c0 + c) * 16 + lane] : 0.0f;
    }
}

// acc += convolution of x, `channels` wide, at this item's pixels. Called by all items of a
// work-group alike.
ALWAYS_INLINE void convolve(
    float8 acc[SPAN],
    local float *values,
    local float *weights,
    global const float *x,
    global const float *weight,
    const int channels,
    const int blocks,
    const int ci,
    const int x0,
    const int y0,
    const int height,
    const int width) {
    const int group = get_local_id(0) % 32;
    local const float *mine =
        values + group / (COLUMNS / SPAN) * PITCH + group % (COLUMNS / SPAN) * SPAN;
    for (int c0 = 0; c0 < channels; c0 += CHUNK) {
        barrier(CLK_LOCAL_MEM_FENCE);
        load_values(values, x, channels, c0, x0, y0, height, width);
        load_weights(weights, weight, blocks, ci, c0);
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int c = 0; c < CHUNK; c++)
#pragma unroll
            for (int ky = 0; ky < 3; ky++) {
                float value[SPAN + 2];
#pragma unroll
                for (int i = 0; i < SPAN + 2; i++)
                    value[i] = mine[c * VALUES + ky * PITCH + i];
#pragma unroll
                for (int kx = 0; kx < 3; kx++) {
                    const float8 w =
                        vload8((c * 9 + ky * 3 + kx) * 4 + get_local_id(0) / 32, weights);
#pragma unroll
                    for (int p = 0; p < SPAN; p++)
                        acc[p] += value[p + kx] * w;
                }
            }
    }
}

// Whether any tile of the work-group's pixels is computed.
static inline bool any_is_computed(
    global const float *tile_count,
    const int x0,
    const int y0,
    const int height,
    const int width) {
    bool any = false;
    for (int y = y0; y < min(y0 + ROWS, height); y += SIDE)
        for (int x = x0; x < min(x0 + COLUMNS, width); x += SIDE)
            any |= tile_is_computed(tile_count, x, y, width);
    return any;
}

// One work-group per (COLUMNS, ROWS, 32 output channels): as conv.cl's.
kernel void conv_forward(
    const int height,
    const int width,
    const int c1,
    const int c2,  // channels of x2; 0 = x2 is not read
    const int co,
    const int relu,                  // negative results become 0
    global const float *x,           // (height, width, c1)
    global const float *x2,          // (height, width, ?)
    global const float *weight,      // (blocks, 3, 3, c1 + c2, 16)
    global const float *bias,        // (?)
    global const float *tile_count,  // (?, ?) 0 = not computed
    global float *out)               // (height, width, co)
{
    local float values[VALUES * CHUNK], weights[CHUNK * 9 * 32];
    const int x0 = get_group_id(0) * COLUMNS, y0 = get_group_id(1) * ROWS,
              block = get_group_id(2) * 2;
    if (!any_is_computed(tile_count, x0, y0, height, width))
        return;  // all items of the work-group alike
    const int ci = c1 + c2, blocks = co / 16 - block,
              channel = block * 16 + get_local_id(0) / 32 * 8;
    float8 acc[SPAN];
    const float8 first = channel < co ? vload8(channel / 8, bias) : (float8)0.0f;
#pragma unroll
    for (int p = 0; p < SPAN; p++)
        acc[p] = first;
    global const float *w = weight + block * 9 * ci * 16;
    convolve(acc, values, weights, x, w, c1, blocks, ci, x0, y0, height, width);
    convolve(acc, values, weights, x2, w + c1 * 16, c2, blocks, ci, x0, y0, height, width);

    const int group = get_local_id(0) % 32;
    const int px = x0 + group % (COLUMNS / SPAN) * SPAN, py = y0 + group / (COLUMNS / SPAN);
    for (int p = 0; p < SPAN; p++)
        if (px + p < width && py < height && channel < co &&
            tile_is_computed(tile_count, px + p, py, width)) {
            // max(., 0) would hide a NaN
            const float8 value = relu ? select(acc[p], (float8)(0.0f), acc[p] < 0.0f) : acc[p];
            vstore8(value, 0, out + ((size_t)py * width + px + p) * co + channel);
        }
}

// One work-group per (COLUMNS, ROWS, 32 input channels): as conv.cl's.
kernel void conv_backward_input(
    const int height,
    const int width,
    const int c,
    const int co,
    const int masked,
    global const float *x,           // (height, width, c)
    global const float *flipped,     // (blocks, 3, 3, co, 16)
    global const float *grad_out,    // (height, width, co)
    global const float *tile_count,  // (?, ?) of grad_x, 0 = not computed
    global float *grad_x)            // (height, width, c)
{
    local float values[VALUES * CHUNK], weights[CHUNK * 9 * 32];
    const int x0 = get_group_id(0) * COLUMNS, y0 = get_group_id(1) * ROWS,
              block = get_group_id(2) * 2;
    if (!any_is_computed(tile_count, x0, y0, height, width)) return;
    const int blocks = c / 16 - block, channel = block * 16 + get_local_id(0) / 32 * 8;
    float8 acc[SPAN];
#pragma unroll
    for (int p = 0; p < SPAN; p++)
        acc[p] = 0.0f;
    convolve(
        acc, values, weights, grad_out, flipped + block * 9 * co * 16, co, blocks, co, x0, y0,
        height, width);

    const int group = get_local_id(0) % 32;
    const int px = x0 + group % (COLUMNS / SPAN) * SPAN, py = y0 + group / (COLUMNS / SPAN);
    for (int p = 0; p < SPAN; p++)
        if (px + p < width && py < height && channel < c &&
            tile_is_computed(tile_count, px + p, py, width)) {
            const size_t at = ((size_t)py * width + px + p) * c + channel;
            const float8 dL_dx =
                masked ? select((float8)0.0f, acc[p], vload8(0, x + at) > 0.0f) : acc[p];
            vstore8(dL_dx, 0, grad_x + at);
        }
}
