// Direct K x K convolution for GPUs (K = KERNEL_SIZE), stride 1, zero padding K / 2, of the tiles
// of a list (tiles.h): the forward pass and the gradient of its input.
//
// A work-group computes GROUP_TILES tiles of the list times QUADS groups of 4 output channels, a
// work-item ROWS lines of one tile times 4 channels, whose 32 sums stay in its registers. CHUNK
// input channels at a time come to local memory, with the weights of all taps. A sum runs over
// channels and taps in one order, whatever the list is: the same bits with all tiles and with some.
#include "common.h"
#include "layers/local.h"

#ifndef ITEMS
#define ITEMS 256  // of a work-group, at least 2 * QUADS
#endif
#define ROWS 2  // lines of a work-item: with all 4 of a tile Intel's threads become narrow
#define GROUP_TILES (ITEMS * ROWS / (QUADS * MAP_TILE))
#define CHUNK (KERNEL_SIZE == 3 ? 4 : 8)  // input channels at a time
// Floats from line to line of a tile's values, each aligned to 4; and from tile to tile: 20 more
// than a multiple of 32, so that the lines of 8 tiles lie in different banks of local memory.
#define LINE (KERNEL_SIZE == 3 ? 8 : 4)
#define PITCH (KERNEL_SIZE == 3 ? 52 : 20)

// Which tile and channels of its work-group's, and from which line on, a work-item computes.
static inline int item_tile(void) {
    return get_local_id(0) % GROUP_TILES;
}
static inline int item_quad(void) {
    return get_local_id(0) / GROUP_TILES % QUADS;
}
static inline int item_line(void) {
    // as a quotient times ROWS times LINE, Intel's CPU runtime computes it without its rounding
    return get_local_id(0) < ITEMS / 2 ? 0 : ROWS;
}

// The place in the list of the work-group's first tile. Not by the group's number: where launches
// share the list, each counts its groups from 0.
static inline int first_tile(void) {
    return get_global_id(0) / ITEMS * GROUP_TILES;
}

// Copy CHUNK channels of x from c0 on to values [channel][tile][line][column], zeros around the
// image, and their weights of all taps to weights [channel][tap][quad].
ALWAYS_INLINE void stage(
    local float *values,
    local float4 *weights,
    local const int2 *corner,
    global const float *x,
    global const float4 *weight,
    const int c0,
    const int channels,
    const int ci,
    const int height,
    const int width) {
    for (int i = get_local_id(0); i < GROUP_TILES * SPAN * SPAN * CHUNK / 4; i += ITEMS) {
        const int c = i % (CHUNK / 4) * 4, pixel = i / (CHUNK / 4) % (SPAN * SPAN),
                  tile = i / (CHUNK / 4 * SPAN * SPAN), column = pixel % SPAN, line = pixel / SPAN;
        const int2 at = corner[tile] + (int2)(column - PAD, line - PAD);
        const float4 v = pixel4(x, at.x, at.y, c0 + c, channels, height, width);
        local float *to = values + (c * GROUP_TILES + tile) * PITCH + line * LINE + column;
        to[0] = v.x;
        to[GROUP_TILES * PITCH] = v.y;
        to[2 * GROUP_TILES * PITCH] = v.z;
        to[3 * GROUP_TILES * PITCH] = v.w;
    }
    for (int i = get_local_id(0); i < TAPS * CHUNK * QUADS; i += ITEMS) {
        const int quad = i % 4, c = i / 4 % CHUNK, tap = i / (4 * CHUNK) % TAPS,
                  block = i / (4 * CHUNK * TAPS);
        weights[(c * TAPS + tap) * QUADS + block * 4 + quad] =
            c0 + c < channels ? weight[((block * TAPS + tap) * ci + c0 + c) * 4 + quad]
                              : (float4)(0.0f);
    }
}

// acc += convolution of x at the work-item's lines. weight: of x's first channel; ci: channels of
// the weights.
ALWAYS_INLINE void convolve(
    float4 acc[ROWS * MAP_TILE],
    local float *values,
    local float4 *weights,
    local const int2 *corner,
    global const float *x,
    global const float4 *weight,
    const int channels,
    const int ci,
    const int height,
    const int width) {
    local const float *mine = values + item_tile() * PITCH + item_line() * LINE;
    for (int c0 = 0; c0 < channels; c0 += CHUNK) {
        barrier(CLK_LOCAL_MEM_FENCE);
        stage(values, weights, corner, x, weight, c0, channels, ci, height, width);
        barrier(CLK_LOCAL_MEM_FENCE);
// No more at a time: AMD's and Intel's compilers would hold the weights of all in registers.
#if KERNEL_SIZE == 3
#pragma unroll 1
#else
#pragma unroll 4
#endif
        for (int c = 0; c < CHUNK; c++)
            UNROLLED_FOR (int ky = 0; ky < KERNEL_SIZE; ky++) {
                local const float4 *w =
                    weights + (c * TAPS + ky * KERNEL_SIZE) * QUADS + item_quad();
                UNROLLED_FOR (int row = 0; row < ROWS; row++) {
                    local const float *line = mine + c * GROUP_TILES * PITCH + (row + ky) * LINE;
                    const float4 a = *(local const float4 *)line;
#if KERNEL_SIZE == 3
                    const float2 b = *(local const float2 *)(line + 4);
                    const float v[SPAN] = {a.x, a.y, a.z, a.w, b.x, b.y};
#else
                    const float v[SPAN] = {a.x, a.y, a.z, a.w};
#endif
                    UNROLLED_FOR (int kx = 0; kx < KERNEL_SIZE; kx++)
                        UNROLLED_FOR (int p = 0; p < MAP_TILE; p++)
                            acc[row * MAP_TILE + p] += v[p + kx] * w[kx * QUADS];
                }
            }
    }
}

// The corners of the work-group's tiles. The last groups take the last tile for those beyond.
ALWAYS_INLINE void find_corners(local int2 *corner, global const int *tile_list) {
    const int item = get_local_id(0), tile = first_tile() + item;
    if (item < GROUP_TILES)
        corner[item] = tile_corner(tile_list[3 + min(tile, tile_list[2] - 1)], tile_list[1]);
    barrier(CLK_LOCAL_MEM_FENCE);
}

// One work-item per (4 channels of out or out2, ROWS lines of a tile), a work-group per (4 * QUADS
// channels, GROUP_TILES tiles of the list): reads what the lines see in x, then in x2 (the
// concatenation [x, x2] without making it), and writes them to out or out2. For input gradients, out
// and out2, x is the gradient of the output, and the weights are flipped (weights.cl).
kernel void conv_local(
    const int c1,
    const int c2,  // channels of x2; 0 = x2 is not read
    const int co1,
    const int co2,                // channels of out2; 0 = out2 is not written
    const int forward,            // add bias
    const int relu,               // negative results become 0
    const int masked,             // results become 0 where, 1: mask is not positive; 2: mask2
    global const float *x,        // (height, width, c1)
    global const float *x2,       // (height, width, ?)
    global const float4 *weight,  // ((co1+15)/16+(co2+15)/16, KERNEL_SIZE, KERNEL_SIZE, c1+c2, 16)
    global const float4 *bias,    // (?) ((co1+15)/16*16)
    global const float *mask,     // (height, width, co1)
    global const float *mask2,    // (height, width, ?)
    global const int *tile_list,  // (?) height, width, number, tiles
    global float *out,            // (height, width, co1)
    global float *out2)           // (height, width, ?)
{
    local float values[CHUNK * GROUP_TILES * PITCH] __attribute__((aligned(16)));
    local float4 weights[CHUNK * TAPS * QUADS];
    local int2 corner[GROUP_TILES];
    find_corners(corner, tile_list);
    const int height = tile_list[0], width = tile_list[1], ci = c1 + c2;
    const int group = get_group_id(1), groups_of_out = (co1 + 4 * QUADS - 1) / (4 * QUADS);
    const bool second = group >= groups_of_out;
    const int channel = ((second ? group - groups_of_out : group) * QUADS + item_quad()) * 4;
    const int co = second ? co2 : co1;
    float4 acc[ROWS * MAP_TILE];
    UNROLLED_FOR (int p = 0; p < ROWS * MAP_TILE; p++)
        acc[p] = forward ? bias[channel / 4] : (float4)(0.0f);
    global const float4 *w = weight + group * QUADS * TAPS * ci;
    for (int source = 0; source < (c2 ? 2 : 1); source++)
        convolve(
            acc, values, weights, corner, source ? x2 : x, source ? w + c1 * 4 : w,
            source ? c2 : c1, ci, height, width);

    if (channel >= co || first_tile() + item_tile() >= tile_list[2]) return;
    const int2 at = corner[item_tile()] + (int2)(0, item_line());
    UNROLLED_FOR (int p = 0; p < ROWS * MAP_TILE; p++) {
        const int px = at.x + p % MAP_TILE, py = at.y + p / MAP_TILE;
        if (px >= width || py >= height) continue;
        const size_t to = ((size_t)py * width + px) * co + channel;
        float4 value = acc[p];
        if (relu) value = select(value, (float4)(0.0f), value < 0.0f);  // max() would hide a NaN
        if (masked & (second ? 2 : 1))
            value = select(
                (float4)(0.0f), value,
                load_quad((second ? mask2 : mask) + to, co - channel) > 0.0f);
        store_quad(value, (second ? out2 : out) + to, co - channel);
    }
}
