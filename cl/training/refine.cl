// The opacities after refining the grid, when a ray crosses two points where it crossed one.
#include "common.h"

// One work-item per point: replaces o by 1 - sqrt(1 - o): two of these in a row have the same
// transmittance 1 - o. Written as o / (1 + sqrt(1 - o)), small opacities stay exact.
kernel void split_opacity(
    const uint n,           // points
    global float *opacity)  // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const float o = opacity[i];
    opacity[i] = o / (1.0f + sqrt(1.0f - o));
}
