// The specular layer of an image (specular.h).
#include "layers/specular.h"
#include "lanes.h"

#ifndef HIDDEN
#define HIDDEN 32  // outputs of the first and of the second layer
#endif
#ifndef GROUP
#define GROUP 1
#endif
#define LEAST_ALPHA 0.02f  // pixels below this alpha get no colour
#define BLOCK 4            // outputs that are summed at a time

// A GPU keeps the values of a pixel in local memory: indexed arrays would spill from registers. Value
// i of a pixel is PLACE(i) values behind its first one; TOGETHER times LANES pixels are a group's.
#ifndef TOGETHER
#define TOGETHER 1
#endif
#if LANES == 1
#define KEPT local
#define PLACE(i) ((i) * TOGETHER)
#else
#define KEPT private
#define PLACE(i) (i)
#endif

// outputs[j] = bias[j] + sum over i of weight[i, j] * inputs[i], j < count; with relu at least 0.
// weight: ((count+15)/16, n, 16).
ALWAYS_INLINE void dense(
    const KEPT floats *inputs,
    const int n,
    global const float *weight,
    global const float *bias,
    KEPT floats *outputs,
    const int count,
    const bool relu) {
    for (int j = 0; j < count; j += BLOCK) {
        global const float *column = weight + j / 16 * n * 16 + j % 16;
        floats a = bias[j], b = bias[j + 1], c = bias[j + 2], d = bias[j + 3];
        for (int i = 0; i < n; i++) {
            const float4 w = vload4(0, column + i * 16);
            a += w.x * inputs[PLACE(i)];
            b += w.y * inputs[PLACE(i)];
            c += w.z * inputs[PLACE(i)];
            d += w.w * inputs[PLACE(i)];
        }
        outputs[PLACE(j)] = relu ? fmax(a, 0.0f) : a;
        outputs[PLACE(j + 1)] = relu ? fmax(b, 0.0f) : b;
        outputs[PLACE(j + 2)] = relu ? fmax(c, 0.0f) : c;
        outputs[PLACE(j + 3)] = relu ? fmax(d, 0.0f) : d;
    }
}

// GROUP work-items per TOGETHER * LANES pixels: add the layer's colours to the pixels that show
// points.
kernel void specular_forward(
    const uint n,  // pixels
    const uint width,
    const float supersampling,          // camera pixels along a side of an image pixel
    const float extent,                 // world units of 1 in places
    global const float *camera,         // (21) camera.h
    global const float *transmittance,  // (n)
    global const float *features,       // (H, W, 16)
    global const float *mean_range,     // (n) of what the pixels show, raster/weights.cl
    global const float *weight_a,       // (HIDDEN/16, 1, 1, INPUTS, 16)
    global const float *bias_a,         // (HIDDEN)
    global const float *weight_b,       // (HIDDEN/16, 1, 1, HIDDEN, 16)
    global const float *bias_b,         // (HIDDEN)
    global const float *weight_c,       // (1, 1, 1, HIDDEN, 16)
    global const float *bias_c,         // (16)
    global float *image)                // (H, W, 3)
{
    KEPT floats kept[TOGETHER * INPUTS], other[TOGETHER * HIDDEN];
    const Camera cam = camera_load(camera);
    for (int own = get_local_id(0); own < TOGETHER; own += GROUP) {
        const size_t first = LANES * (TOGETHER * get_group_id(0) + own);
        if (first >= n) return;
        const int count = min(n - (uint)first, (uint)LANES);
        float alpha[LANES], most = 0.0f;
        for (int lane = 0; lane < LANES; lane++) {
            alpha[lane] = lane < count ? 1.0f - transmittance[first + lane] : 0.0f;
            most = fmax(most, alpha[lane]);
        }
        if (most < LEAST_ALPHA) continue;

        KEPT floats *inputs = kept + own, *hidden = other + own;
        floats direction[3], place[3], encoded[INPUTS - CHANNELS];
        for (int lane = 0; lane < LANES; lane++) {
            const uint pixel = first + min(lane, count - 1);
            for (int c = 0; c < CHANNELS; c++)
                ((KEPT float *)(inputs + PLACE(c)))[lane] = features[(size_t)CHANNELS * pixel + c];
            const float3 d = direction_of(&cam, pixel % width, pixel / width, supersampling);
            ((float *)direction)[lane] = d.x;
            ((float *)(direction + 1))[lane] = d.y;
            ((float *)(direction + 2))[lane] = d.z;
            const float3 p = place_of(&cam, d, mean_range[pixel], extent);
            ((float *)place)[lane] = p.x;
            ((float *)(place + 1))[lane] = p.y;
            ((float *)(place + 2))[lane] = p.z;
        }
        ENCODE(floats, direction, OCTAVES, encoded)
        ENCODE(floats, place, PLACE_OCTAVES, (encoded + DIRECTION_INPUTS))
        UNROLLED_FOR (int i = CHANNELS; i < INPUTS; i++)
            inputs[PLACE(i)] = encoded[i - CHANNELS];

        dense(inputs, INPUTS, weight_a, bias_a, hidden, HIDDEN, true);
        dense(hidden, HIDDEN, weight_b, bias_b, inputs, HIDDEN, true);
        dense(inputs, HIDDEN, weight_c, bias_c, hidden, BLOCK, false);
        for (int lane = 0; lane < count; lane++)
            if (alpha[lane] >= LEAST_ALPHA)
                for (int c = 0; c < 3; c++)
                    image[3 * (first + lane) + c] +=
                        0.5f * alpha[lane] * ((KEPT float *)(hidden + PLACE(c)))[lane];
    }
}
