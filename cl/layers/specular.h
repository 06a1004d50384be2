// The finish: a small network of each pixel alone, of its features and of the direction it is seen
// in, whose colours times alpha are added to the image. It is fitted once a training has ended.
#ifndef PP_SPECULAR_H
#define PP_SPECULAR_H

#include "camera.h"
#include "common.h"

#define OCTAVES 4
#define INPUTS (CHANNELS + 3 + 6 * OCTAVES)
#define HALF_PI 1.57079632679489662f

// encoded[0..26] of the unit vector d[3], of numbers or lanes, as NeRF encodes positions: itself,
// then sines and cosines of 2^k pi/2 times it, by the formulas of the doubled angle.
#define ENCODE(type, d, encoded)                                                                   \
    for (int c = 0; c < 3; c++) {                                                                  \
        type cosine, sine = sincos(HALF_PI * d[c], &cosine);                                       \
        encoded[c] = d[c];                                                                         \
        for (int k = 0; k < OCTAVES; k++) {                                                        \
            encoded[3 + 6 * k + c] = sine;                                                         \
            encoded[6 + 6 * k + c] = cosine;                                                       \
            const type twice = 2.0f * sine * cosine;                                               \
            cosine = 1.0f - 2.0f * sine * sine;                                                    \
            sine = twice;                                                                          \
        }                                                                                          \
    }

// Unit vector, in world axes, from the eye to the centre of a pixel. side: pixels of the camera in
// one, each way.
static inline float3 direction_of(const Camera *cam, const uint x, const uint y, const float side) {
    const float across = (side * (x + 0.5f) - cam->cx) / cam->fx;
    const float down = (side * (y + 0.5f) - cam->cy) / cam->fy;
    return normalize(across * cam->right + down * cam->down + cam->forward);
}

#endif
