// The regular grid of the points, read from one buffer of 8 floats: origin x, y, z; edge; nx, ny,
// nz; 0. pp_cl/scene/grid.py writes it. World coordinates count from a centre near the points.
#ifndef PP_GRID_H
#define PP_GRID_H

// World position of the grid's vertex (i, j, k), whose id is i + nx*(j + ny*k).
static inline float3 grid_position(global const float *grid, const uint id) {
    const uint nx = (uint)grid[4], ny = (uint)grid[5];
    const uint row = id / nx;
    const float3 ijk = (float3)((float)(id - row * nx), (float)(row % ny), (float)(row / ny));
    return (float3)(grid[0], grid[1], grid[2]) + grid[3] * ijk;
}

#endif
