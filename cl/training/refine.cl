// Opacities of a refined grid.

// One work-item per point: replaces o by 1 - sqrt(1 - o), of which two in a row hide as much. The
// form without a difference keeps small opacities exact.
kernel void split_opacity(
    const uint n,           // points
    global float *opacity)  // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const float o = opacity[i];
    opacity[i] = o / (1.0f + sqrt(1.0f - o));
}
