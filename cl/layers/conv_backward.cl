// Direct K x K convolution (direct.h): the backward pass, of the weights and the bias and of the
// input. One launch does both, as either alone may be too little for all compute units.
#include "layers/direct.h"

#ifndef CI_GROUP
#define CI_GROUP 8  // input channels of a work-item; K * CI_GROUP accumulators fit AVX-512
#endif
// pixels of a row summed in registers: one sum over an image of background would lose digits
#define SUMMED 128

// The gradients of 16 channels, `count` times; 0 where count is, whatever they are.
static inline float16 counted(global const float *grad, const float count, const int lanes) {
    return count > 0.0f ? count * load16(grad, lanes) : (float16)0.0f;
}

// The first work-items: one per (CI_GROUP channels of [x, x2] and ky, 16 output channels, `rows`
// rows of the image): reads its rows and the gradients of the K output pixels that see each pixel,
// writes its part of the sums: dL/dweight in rows (ky, kx, channel) of partial, dL/dbias in the last
// row. Only pixels that exist are visited. A gradient counts as often as its tile.
//
// The others: one per (PIXELS pixels, row, BLOCKS * 16 channels of x or x2): reads grad_out, writes
// those of grad_x or grad_x2 that lie in a tile to compute: the convolution of grad_out with the
// flipped and transposed weights (weights.cl). masked: 1 if x is the output of a ReLU and grad_x the
// gradient of that ReLU's input, so that the mask costs no pass of its own; plus 2 if x2 is.
kernel void conv_backward(
    const int height,
    const int width,
    const int c1,
    const int c2,  // channels of x2; 0 = there is none
    const int co,
    const int masked,
    const int rows,
    global const float *x,           // (height, width, c1)
    global const float *x2,          // (height, width, ?)
    global const float16 *flipped,   // ((c1+15)/16+(c2+15)/16, KERNEL_SIZE, KERNEL_SIZE, co, 16)
    global const float *grad_out,    // (height, width, co)
    global const float *tile_count,  // ((height+3)/4, (width+3)/4) of grad_out; 0 = not read
    global const float *grad_tiles,  // ((height+3)/4, (width+3)/4) of grad_x; 0 = not computed
    global float16 *partial,  // (?, (co+15)/16, KERNEL_SIZE*KERNEL_SIZE*(c1+c2)+1, 16) of each part
    global float *grad_x,     // (height, width, c1)
    global float *grad_x2)    // (height, width, ?)
{
    const int ci = c1 + c2, groups = ci / CI_GROUP, blocks_out = (co + 15) / 16;
    const int parts = (height + rows - 1) / rows, sums = KERNEL_SIZE * groups * blocks_out * parts;
    int item = get_global_id(0);
    if (item < sums) {
        const int ky = item / groups % KERNEL_SIZE, c0 = item % groups * CI_GROUP;
        const int at = item / (groups * KERNEL_SIZE), block = at % blocks_out,
                  part = at / blocks_out;
        const bool second = c0 >= c1, with_bias = ky == PAD && c0 == 0;
        const int c = second ? c2 : c1, lanes = co - block * 16;
        global float16 *of_block = partial + ((size_t)part * blocks_out + block) * (TAPS * ci + 1);
        global float16 *out = of_block + ky * KERNEL_SIZE * ci + c0, *bias = of_block + TAPS * ci;
        for (int kx = 0; kx < KERNEL_SIZE; kx++)
            for (int i = 0; i < CI_GROUP; i++)
                out[kx * ci + i] = 0.0f;
        if (with_bias) *bias = 0.0f;

        for (int y = part * rows; y < min(height, (part + 1) * rows); y++) {
            const int row = y + ky - PAD;
            if (row < 0 || row >= height) continue;
            global const float *pixel = (second ? x2 + c0 - c1 : x + c0) + (size_t)row * width * c;
            global const float *grad = grad_out + (size_t)y * width * co + block * 16;
            global const float *count = tile_count + y / MAP_TILE * tile_columns(width);
            float16 window[KERNEL_SIZE];  // window[kx]: dL/dout at column + PAD - kx
            UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
                window[kx] = 0.0f;
            if (PAD) window[0] = counted(grad, count[0], lanes);
            for (int begin = 0; begin < width; begin += SUMMED) {
                float16 acc[KERNEL_SIZE][CI_GROUP], sum = 0.0f;
                UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
                    UNROLLED_FOR (int i = 0; i < CI_GROUP; i++)
                        acc[kx][i] = 0.0f;
                for (int column = begin; column < min(begin + SUMMED, width); column++) {
                    UNROLLED_FOR (int kx = KERNEL_SIZE - 1; kx > 0; kx--)
                        window[kx] = window[kx - 1];
                    const int ahead = column + PAD;
                    window[0] = ahead < width
                                    ? counted(grad + ahead * co, count[ahead / MAP_TILE], lanes)
                                    : (float16)0.0f;
                    // pixels that no counted gradient sees may hold anything
                    if (count[max(column - PAD, 0) / MAP_TILE] == 0.0f &&
                        count[min(column + PAD, width - 1) / MAP_TILE] == 0.0f)
                        continue;
                    UNROLLED_FOR (int i = 0; i < CI_GROUP; i++) {
                        const float value = pixel[column * c + i];
                        UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
                            acc[kx][i] += value * window[kx];
                    }
                    sum += window[PAD];
                }
                UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
                    UNROLLED_FOR (int i = 0; i < CI_GROUP; i++)
                        out[kx * ci + i] += acc[kx][i];
                if (with_bias) *bias += sum;
            }
        }
        return;
    }
    item -= sums;
    const int columns = (width + PIXELS - 1) / PIXELS;
    convolve_pixels(
        grad_out, 0, co, 0, flipped, 0, 0, masked & 1 ? x : 0, masked & 2 ? x2 : 0, grad_x, grad_x2,
        c1, c2, grad_tiles,
        (int3)(item % columns, item / columns % height, item / columns / height), height, width);
}
