// The regular grid of the points, read from one buffer of 8 floats: origin x, y, z; voxel size; nx,
// ny, nz; 0. pp_cl/engine/grid.py writes it, and numbers the vertices alike: brick by brick, bricks
// and the vertices in each x first. World coordinates count from a centre near the points.
#ifndef PP_GRID_H
#define PP_GRID_H

#define BRICK_BITS 3  // of an id, along each axis
#define BRICK (1u << BRICK_BITS)

// Bricks along an axis of n vertices.
static inline uint bricks(const float n) {
    return ((uint)n + BRICK - 1) / BRICK;
}

// The vertex (i, j, k) with an id.
static inline uint3 grid_vertex(global const float *grid, const uint id) {
    const uint nx = bricks(grid[4]), ny = bricks(grid[5]);
    const uint brick = id >> 3 * BRICK_BITS, row = brick / nx;
    const uint3 inside = (uint3)(id, id >> BRICK_BITS, id >> 2 * BRICK_BITS) & (BRICK - 1);
    return BRICK * (uint3)(brick - row * nx, row % ny, row / ny) + inside;
}

#endif
