// The specular layer: a small network turns the features, the viewing direction and the place of one
// pixel into a colour, which times alpha is added to the image. It is fitted after the training.
#ifndef PP_SPECULAR_H
#define PP_SPECULAR_H

#include "camera.h"
#include "common.h"

#define OCTAVES 4        // of sines and cosines of the direction
#define PLACE_OCTAVES 2  // of the place
#define DIRECTION_INPUTS (3 + 6 * OCTAVES)
#define PLACE_INPUTS (3 + 6 * PLACE_OCTAVES)
#define INPUTS (CHANNELS + DIRECTION_INPUTS + PLACE_INPUTS)
#define HALF_PI 1.57079632679489662f

// encoded[0..3 + 6 octaves] of d[3] (of floats, or of vectors with a lane per pixel), as NeRF encodes
// positions: d, then sines and cosines of 2^k pi/2 d, by the double-angle formulas.
#define ENCODE(type, d, octaves, encoded)                                                          \
    UNROLLED_FOR (int c = 0; c < 3; c++) {                                                         \
        type cosine, sine = sincos(HALF_PI * d[c], &cosine);                                       \
        encoded[c] = d[c];                                                                         \
        UNROLLED_FOR (int k = 0; k < octaves; k++) {                                               \
            encoded[3 + 6 * k + c] = sine;                                                         \
            encoded[6 + 6 * k + c] = cosine;                                                       \
            const type twice = 2.0f * sine * cosine;                                               \
            cosine = 1.0f - 2.0f * sine * sine;                                                    \
            sine = twice;                                                                          \
        }                                                                                          \
    }

// Unit vector, in world axes, from the eye to the centre of a pixel. supersampling: camera pixels
// along a side of an image pixel.
static inline float3
direction_of(const Camera *cam, const uint x, const uint y, const float supersampling) {
    const float across = (supersampling * (x + 0.5f) - cam->cx) / cam->fx;
    const float down = (supersampling * (y + 0.5f) - cam->cy) / cam->fy;
    return normalize(across * cam->right + down * cam->down + cam->forward);
}

// The place that a pixel shows, from the middle of the scene in units of `extent`: where its ray is
// at a range.
static inline float3
place_of(const Camera *cam, const float3 direction, const float range, const float extent) {
    return (cam->eye + range * direction) / extent;
}

#endif
