// Smoothing of the SH coefficients over the grid: f += amount * (mean of the up to 6 neighbours - f),
// in place: of the points whose grid indices add up to an even number, then of the others. All
// neighbours of a point are of the other colour.
#include "common.h"
#include "grid.h"
#include "lanes.h"

// The id of a vertex (i, j, k): the inverse of grid_vertex().
static inline uint grid_id(global const float *grid, const uint3 vertex) {
    const uint nx = bricks(grid[4]), ny = bricks(grid[5]);
    const uint3 brick = vertex / BRICK, inside = vertex % BRICK;
    return (brick.x + nx * (brick.y + ny * brick.z)) << 3 * BRICK_BITS |
           (inside.x | inside.y << BRICK_BITS | inside.z << 2 * BRICK_BITS);
}

// Index of `id` in ids[first, last), ascending; NONE where it is missing.
static inline uint find(global const uint *ids, const uint id, uint first, uint last) {
    const uint end = last;
    while (first < last) {
        const uint middle = first + (last - first) / 2;
        if (ids[middle] < id)
            first = middle + 1;
        else
            last = middle;
    }
    return first < end && ids[first] == id ? first : NONE;
}

// One work-item per point: reads the ascending grid ids, writes the indices of its neighbours -x,
// +x, -y, +y, -z, +z, and its colour.
kernel void neighbour_table(
    const uint n,              // points
    global const float *grid,  // (8)
    global const uint *ids,    // (N) grid ids, ascending
    global uint *neighbours,   // (N, 6)
    global uchar *colour)      // (N) 0 or 1
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const uint3 at = grid_vertex(grid, ids[i]);
    const uint3 steps[3] = {(uint3)(1, 0, 0), (uint3)(0, 1, 0), (uint3)(0, 0, 1)};
    const uint place[3] = {at.x, at.y, at.z};
    colour[i] = (at.x + at.y + at.z) & 1;
    global uint *row = neighbours + 6 * (size_t)i;
    for (uint axis = 0; axis < 3; axis++) {  // along each, ids ascend
        const uint before = grid_id(grid, at - steps[axis]);
        const uint behind = grid_id(grid, at + steps[axis]);
        row[2 * axis] = place[axis] > 0 ? find(ids, before, 0, i) : NONE;
        row[2 * axis + 1] =
            place[axis] + 1 < (uint)grid[4 + axis] ? find(ids, behind, i + 1, n) : NONE;
    }
}

// One work-item per part of a point: moves its coefficients if it is of this colour.
kernel void smooth_colour(
    const uint n,                   // points
    const uint k,                   // coefficients of a point
    const uint moved,               // colour
    const float amount,             // 0 to 1
    global const uint *neighbours,  // (N, 6)
    global const uchar *colour,     // (N)
    global float16 *sh)             // (N, K, 16)
{
    const size_t i = get_global_id(0) / ROW_PARTS;
    if (i >= n || colour[i] != moved) return;
    uint around[6];
    float weight = 0.0f;
    for (int side = 0; side < 6; side++) {
        const uint j = neighbours[6 * i + side];
        around[side] = j == NONE ? i : j;
        weight += j == NONE ? 0.0f : 1.0f;
    }
    weight = amount / fmax(weight, 1.0f);
    for (size_t c = 0; c < k; c++) {
        const floats f = load_part(sh, i * k + c);
        floats sum = 0.0f;
        for (int side = 0; side < 6; side++)
            sum += load_part(sh, (size_t)around[side] * k + c) - f;  // 0 for a missing neighbour
        store_part(f + weight * sum, sh, i * k + c);
    }
}
