// View-dependent features: spherical harmonics of the direction from the eye.
#include "common.h"
#include "camera.h"
#include "sh.h"

#ifndef DEGREE
#define DEGREE 2  // of the highest harmonics in use: 0, 1 or 2
#endif
#define BASES ((DEGREE + 1) * (DEGREE + 1))

// Harmonics of the direction, in world axes, of a point given in camera axes. A point that was left
// out is (0, 0, 0, -1).
static inline void shade_basis(global const float *camera, const float4 point, float *basis) {
    const Camera k = camera_load(camera);
    const float3 c = point.xyz / point.w;
    sh_basis(c.x * k.right + c.y * k.down + c.z * k.forward, basis);
}

// One work-item per seen point: reads its coefficients and where it is, writes its features.
kernel void shade_forward(
    const uint s,                       // seen points
    global const uint *seen,            // (S) their indices
    global const float *camera,         // (20) camera.h
    global const float4 *point_camera,  // (N, 4) x, y, z, distance
    global const float16 *sh0,          // (N, 1, 16)
    global const float16 *sh1,          // (?, ?, 16) (N, 3, 16), not read at degree 0
    global const float16 *sh4,          // (?, ?, 16) (N, 3, 16), not read below degree 2
    global const float16 *sh7,          // (?, ?, 16) (N, 2, 16), not read below degree 2
    global float16 *point_features)     // (N, 16) only the seen rows are written
{
    const uint g = get_global_id(0);
    if (g >= s) return;
    const uint i = seen[g];
    float basis[9];
    shade_basis(camera, point_camera[i], basis);
    float16 f = basis[0] * sh0[i];
    if (DEGREE >= 1)
        for (uint b = 0; b < 3; b++)
            f += basis[1 + b] * sh1[3 * i + b];
    if (DEGREE >= 2) {
        for (uint b = 0; b < 3; b++)
            f += basis[4 + b] * sh4[3 * i + b];
        for (uint b = 0; b < 2; b++)
            f += basis[7 + b] * sh7[2 * i + b];
    }
    point_features[i] = f;
}

// One work-item per point: reads the gradient of its features, writes that of its coefficients (0
// where the first is 0).
kernel void shade_backward(
    const uint n,                               // points
    global const float *camera,                 // (20) camera.h
    global const float4 *point_camera,          // (N, 4) x, y, z, distance
    global const float16 *grad_point_features,  // (N, 16)
    global float16 *grad_sh0,                   // (N, 1, 16)
    global float16 *grad_sh1,                   // (?, ?, 16) (N, 3, 16), not written at degree 0
    global float16 *grad_sh4,                   // (?, ?, 16) (N, 3, 16), not written below degree 2
    global float16 *grad_sh7)                   // (?, ?, 16) (N, 2, 16), not written below degree 2
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const float16 dL_df = grad_point_features[i];
    float basis[9];
    shade_basis(camera, point_camera[i], basis);
    grad_sh0[i] = basis[0] * dL_df;
    if (DEGREE >= 1)
        for (uint b = 0; b < 3; b++)
            grad_sh1[3 * i + b] = basis[1 + b] * dL_df;
    if (DEGREE >= 2) {
        for (uint b = 0; b < 3; b++)
            grad_sh4[3 * i + b] = basis[4 + b] * dL_df;
        for (uint b = 0; b < 2; b++)
            grad_sh7[2 * i + b] = basis[7 + b] * dL_df;
    }
}
