// Smoothing of the SH coefficients over the grid: f += amount * (mean of the up to 6 neighbours -
// f).
#include "common.h"
#include "lanes.h"

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
// +x, -y, +y, -z, +z.
kernel void neighbour_table(
    const uint n,              // points
    global const float *grid,  // (8)
    global const uint *ids,    // (N) grid ids, ascending
    global uint *neighbours)   // (N, 6)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const uint nx = grid[4], ny = grid[5], plane = nx * ny;
    const uint id = ids[i], x = id % nx, y = id / nx % ny;
    global uint *row = neighbours + 6 * (size_t)i;
    row[0] = x > 0 ? find(ids, id - 1, 0, i) : NONE;
    row[1] = x + 1 < nx ? find(ids, id + 1, i + 1, n) : NONE;
    row[2] = y > 0 ? find(ids, id - nx, 0, i) : NONE;
    row[3] = y + 1 < ny ? find(ids, id + nx, i + 1, n) : NONE;
    row[4] = id >= plane ? find(ids, id - plane, 0, i) : NONE;
    row[5] = find(ids, id + plane, i + 1, n);
}

// One work-item per `run` points: reads their neighbours, writes how many rows the furthest one
// lies after its point.
kernel void furthest_neighbours(
    const uint n,                   // points
    const uint run,                 // points of a work-item
    global const uint *neighbours,  // (N, 6)
    global uint *furthest)          // (?) one number a work-item
{
    const uint g = get_global_id(0), first = g * run;
    if (first >= n) return;
    uint most = 0;
    for (uint i = first; i < min(first + run, n); i++)
        for (int side = 1; side < 6; side += 2) {
            const uint j = neighbours[6 * (size_t)i + side];
            most = max(most, j == NONE ? 0 : j - i);
        }
    furthest[g] = most;
}

// One work-item per part of a point of a chunk: reads all its coefficients and its neighbours',
// writes the smoothed ones.
kernel void smooth_gather(
    const uint n,                   // points
    const uint first,               // point of the chunk
    const uint count,               // points in the chunk
    const uint k,                   // coefficients of a point
    const float amount,             // 0 to 1
    global const uint *neighbours,  // (N, 6)
    global const float16 *sh,       // (N, K, 16)
    global float16 *smoothed)       // (?, 16) K rows a point of the chunk
{
    const size_t slot = get_global_id(0) / ROW_PARTS, i = first + slot;
    if (slot >= count) return;
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
        store_part(f + weight * sum, smoothed, slot * k + c);
    }
}

// One work-item per part of a point of a chunk: writes its coefficients back.
kernel void smooth_write_back(
    const uint n,                    // points
    const uint first,                // point of the chunk
    const uint count,                // points in the chunk
    const uint k,                    // coefficients of a point
    global const float16 *smoothed,  // (?, 16) K rows a point of the chunk
    global float16 *sh)              // (N, K, 16)
{
    const size_t slot = get_global_id(0) / ROW_PARTS;
    if (slot >= count) return;
    for (size_t c = 0; c < k; c++)
        store_part(load_part(smoothed, slot * k + c), sh, (first + slot) * k + c);
}
