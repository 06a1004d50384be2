// Shading: the features of the visible points, from their spherical harmonics coefficients in the
// direction from the eye.
#include "common.h"
#include "lanes.h"
#include "raster/footprint.h"
#include "sh.h"

#ifndef DEGREE
#define DEGREE 2  // of the highest harmonics in use: 0, 1 or 2
#endif

// One work-item per part of a visible point: reads its coefficients and where it is, writes its
// features.
kernel void shade_forward(
    const uint s,                      // visible points
    global const uint *visible,        // (?) their indices, S
    global const float *camera,        // (21) camera.h
    global const uint *point_record,   // (N, RECORD) footprint.h
    global const float16 *sh_0,        // (N, 1, 16)
    global const float16 *sh_1,        // (?, ?, 16) (N, 3, 16), not read at degree 0
    global const float16 *sh_2a,       // (?, ?, 16) (N, 3, 16), not read below degree 2
    global const float16 *sh_2b,       // (?, ?, 16) (N, 2, 16), not read below degree 2
    global float16 *visible_features)  // (?, 16) a row for each
{
    const uint g = get_global_id(0) / ROW_PARTS;
    if (g >= s) return;
    const uint i = visible[g];
    SH_READ_AHEAD(visible[min(g + POINTS_AHEAD, s - 1)])
    float basis[9];
    const float4 at = as_float4(vload4(i * (size_t)(RECORD / 4), point_record));
    sh_basis_of_point(camera, at, basis);
    floats features = basis[0] * load_part(sh_0, i);
    if (DEGREE >= 1)
        for (uint b = 0; b < 3; b++)
            features += basis[1 + b] * load_part(sh_1, 3 * i + b);
    if (DEGREE >= 2) {
        for (uint b = 0; b < 3; b++)
            features += basis[4 + b] * load_part(sh_2a, 3 * i + b);
        for (uint b = 0; b < 2; b++)
            features += basis[7 + b] * load_part(sh_2b, 2 * i + b);
    }
    if (CLAMPED) features = features < 0.0f ? 0.0f : features;  // a NaN stays one
    store_part(features, visible_features, g);
}
