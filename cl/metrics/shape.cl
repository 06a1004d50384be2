// The vertices of a regular grid that are nearest to some point of a triangle mesh, by samples.
#include "common.h"

// Samples that a work-item takes, one after the other
#ifndef RUN
#define RUN 256
#endif

// Three numbers of sample s that fill the unit cube evenly, in units of 2^-32: its multiples of
// powers of 1 / 1.2207440846, the root of x^4 = x + 1 (Roberts 2018, sequence R3).
#define FIRST_OF(s) ((s) * 0xd1b54a33u)
#define SECOND_OF(s) ((s) * 0xabc98389u)
#define THIRD_OF(s) ((s) * 0x8cb92ba7u)

// A number in [0, 1) of the 24 highest bits.
static inline float unit(const uint number) {
    return (number >> 8) * 0x1p-24f;
}

// One work-item per RUN samples: walks along the triangles laid end to end by their areas, which
// add up to 2^60, with one sample in each of `samples` equal stretches; sets the bit of the vertex
// nearest to each. Sets are bitsets as in cl/scene/hull.cl. The bits do not depend on the order.
kernel void sample_surface(
    const uint samples,
    const uint first,  // number of this launch's first sample
    const uint count,  // samples of this launch
    const uint triangles,
    const uint nx,
    const uint ny,
    const uint nz,
    const uint words,              // words per row
    global const ulong *area_end,  // (TRIANGLES) areas of the triangles up to and with this one
    global const float4 *corners,  // (TRIANGLES, 3, 4) in units of the voxel size from vertex 0
    global uint *bits)             // (NY*NZ, WORDS)
{
    const uint begin = get_global_id(0) * RUN;
    if (begin >= count) return;
    const ulong stretch = (1ul << 60) / samples;
    uint triangle = NONE;
    for (uint s = first + begin; s < first + min(begin + RUN, count); s++) {
        const ulong offset = mul_hi((ulong)FIRST_OF(s) << 32, stretch);
        const ulong place = s * stretch + offset;
        if (triangle == NONE) {
            triangle = 0;
            for (uint above = triangles - 1; triangle < above;) {
                const uint middle = (triangle + above) / 2;
                if (area_end[middle] > place)
                    above = middle;
                else
                    triangle = middle + 1;
            }
        }
        while (triangle < triangles - 1 && area_end[triangle] <= place)
            triangle++;
        const float out = sqrt(unit(SECOND_OF(s)));
        const float across = unit(THIRD_OF(s));
        const float4 at = (1.0f - out) * corners[3 * triangle] +
                          out * ((1.0f - across) * corners[3 * triangle + 1] +
                                 across * corners[3 * triangle + 2]);
        const uint i = (uint)floor(at.x + 0.5f), j = (uint)floor(at.y + 0.5f),
                   k = (uint)floor(at.z + 0.5f);
        if (i < nx && j < ny && k < nz)
            atomic_or(&bits[(k * ny + j) * words + i / 32], 1u << i % 32);
    }
}
