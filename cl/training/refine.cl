// The opacities after refining the grid, when a ray crosses two points where it crossed one.
#include "common.h"
#include "cloud.h"

// One work-item per point: replaces o by 1 - sqrt(1 - o): two of these in a row have the same
// transmittance 1 - o. Written as o / (1 + sqrt(1 - o)), small opacities stay exact. What
// depends on the direction is divided alike, as an opacity near o needs.
kernel void split_opacity(
    const uint n,           // points
    global float *opacity)  // (N, OPACITIES) cloud.h
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const float divisor = 1.0f + sqrt(1.0f - opacity[OPACITIES * (size_t)i]);
    for (uint k = 0; k < OPACITIES; k++)
        opacity[OPACITIES * (size_t)i + k] /= divisor;
}
