// The specular layer of an image (specular.h).
#include "layers/specular.h"
#include "lanes.h"

#ifndef HIDDEN
#define HIDDEN 32  // outputs of the first and of the second layer
#endif
#define LEAST_ALPHA 0.02f  // pixels below this alpha get no colour
#define BLOCK 4            // outputs that are summed at a time

// outputs[j] = bias[j] + sum over i of weight[i, j] * inputs[i], j < count; with relu at least 0.
// weight: ((count+15)/16, n, 16).
ALWAYS_INLINE void dense(
    const floats *inputs,
    const int n,
    global const float *weight,
    global const float *bias,
    floats *outputs,
    const int count,
    const bool relu) {
    GPU_UNROLLED_FOR (int j = 0; j < count; j += BLOCK) {
        global const float *column = weight + j / 16 * n * 16 + j % 16;
        floats a = bias[j], b = bias[j + 1], c = bias[j + 2], d = bias[j + 3];
        GPU_UNROLLED_FOR (int i = 0; i < n; i++) {
            const float4 w = vload4(0, column + i * 16);
            a += w.x * inputs[i];
            b += w.y * inputs[i];
            c += w.z * inputs[i];
            d += w.w * inputs[i];
        }
        outputs[j] = relu ? fmax(a, 0.0f) : a;
        outputs[j + 1] = relu ? fmax(b, 0.0f) : b;
        outputs[j + 2] = relu ? fmax(c, 0.0f) : c;
        outputs[j + 3] = relu ? fmax(d, 0.0f) : d;
    }
}

// One work-item per LANES pixels: adds the layer's colours to the pixels that show points.
kernel void specular_forward(
    const uint n,  // pixels
    const uint width,
    const float side,                   // camera pixels along a side of an image pixel
    global const float *camera,         // (21) camera.h
    global const float *transmittance,  // (n)
    global const float *features,       // (H, W, 16)
    global const float *weight_a,       // (HIDDEN/16, 1, 1, INPUTS, 16)
    global const float *bias_a,         // (HIDDEN)
    global const float *weight_b,       // (HIDDEN/16, 1, 1, HIDDEN, 16)
    global const float *bias_b,         // (HIDDEN)
    global const float *weight_c,       // (1, 1, 1, HIDDEN, 16)
    global const float *bias_c,         // (16)
    global float *image)                // (H, W, 3)
{
    const size_t first = LANES * get_global_id(0);
    if (first >= n) return;
    const int count = min(n - (uint)first, (uint)LANES);
    float alpha[LANES], most = 0.0f;
    for (int lane = 0; lane < LANES; lane++) {
        alpha[lane] = lane < count ? 1.0f - transmittance[first + lane] : 0.0f;
        most = fmax(most, alpha[lane]);
    }
    if (most < LEAST_ALPHA) return;

    const Camera cam = camera_load(camera);
    floats inputs[INPUTS], direction[3];
    for (int lane = 0; lane < LANES; lane++) {
        const uint pixel = first + min(lane, count - 1);
        for (int c = 0; c < CHANNELS; c++)
            ((float *)(inputs + c))[lane] = features[(size_t)CHANNELS * pixel + c];
        const float3 d = direction_of(&cam, pixel % width, pixel / width, side);
        ((float *)direction)[lane] = d.x;
        ((float *)(direction + 1))[lane] = d.y;
        ((float *)(direction + 2))[lane] = d.z;
    }
    floats *encoded = inputs + CHANNELS;
    ENCODE(floats, direction, encoded)

    floats seen[HIDDEN], hidden[HIDDEN], colours[BLOCK];
    dense(inputs, INPUTS, weight_a, bias_a, seen, HIDDEN, true);
    dense(seen, HIDDEN, weight_b, bias_b, hidden, HIDDEN, true);
    dense(hidden, HIDDEN, weight_c, bias_c, colours, BLOCK, false);
    for (int lane = 0; lane < count; lane++)
        if (alpha[lane] >= LEAST_ALPHA)
            for (int c = 0; c < 3; c++)
                image[3 * (first + lane) + c] +=
                    0.5f * alpha[lane] * ((float *)(colours + c))[lane];
}
