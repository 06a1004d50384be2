// An image in the colours of the model, once these are corrected: exposure.cl has the matrices.
#include "common.h"
#include "training/exposure.h"

// One work-item per target pixel: writes the image as the model's colours have it.
kernel void exposure_undo(
    const uint hw,  // pixels of the target
    const uint view,
    global const float4 *exposure,  // (VIEWS, ROWS, 4)
    global const float *image,      // (H, W, 3)
    global const float *alpha,      // (H, W)
    global float *target)           // (H, W, 3)
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    global const float4 *m = exposure + ROWS * view + MATRIX;
    const float white = 1.0f - alpha[q];
    const float3 shift = (float3)(m[0].w, m[1].w, m[2].w);
    const float3 c = vload3(q, image) - white - alpha[q] * shift;
    // Cramer's rule
    const float3 r = m[0].xyz, g = m[1].xyz, b = m[2].xyz;
    const float3 gb = cross(g, b), br = cross(b, r), rg = cross(r, g);
    vstore3((c.x * gb + c.y * br + c.z * rg) / dot(r, gb) + white, q, target);
}
