// Projection of the points of a grid, as raster/project.h does it, with their opacities.
#include "common.h"
#include "camera.h"
#include "grid.h"
#include "lanes.h"
#include "cloud.h"
#include "scan.h"
#include "sh.h"
#include "raster/project.h"

// Whether all points of a brick miss the image, wherever they are in their cells. id: of one of
// them. radius: of a point without offsets.
ALWAYS_INLINE bool
brick_misses(const Camera *cam, global const float *grid, const uint id, const float radius) {
    const float half_side = 0.5f * (BRICK - 1), voxel_size = grid[3];
    const uint first = id >> 3 * BRICK_BITS << 3 * BRICK_BITS;
    const float3 corner = (float3)(grid[0], grid[1], grid[2]) - cam->eye;
    const float3 centre =
        corner + voxel_size * (convert_float3(grid_vertex(grid, first)) + half_side);
    const float reach = 1.7321f * voxel_size * (half_side + MOST_OFFSET);  // to a corner
    const float pixels = LEAST_RADIUS * (length(centre) + reach) / least_focal(cam);
    const floats wide = reach + fmax(LARGEST(radius), pixels);
    const floats x = dot(cam->right, centre), y = dot(cam->down, centre);
    const floats z = dot(cam->forward, centre);
    return !ANY_LANE(
        reaches_image(x, z, wide, cam->fx, cam->cx, cam->width) &
        reaches_image(y, z, wide, cam->fy, cam->cy, cam->height));
}

// id / n lane by lane, which no vector instruction does; *id becomes the remainder.
ALWAYS_INLINE uints divide(uints *id, const uint n) {
    const uints low = mul_hi(*id, (uints)(UINT_MAX / n));  // at most 1 too small
    const uints rest = *id - low * n;
    const uints more = select((uints)(0), (uints)(1), rest >= n);
    *id = rest - more * n;
    return low + more;
}

// The opacities of `count` points from `first` on, as cloud.h has them, in the direction from the eye,
// (x, y, z) of any length.
ALWAYS_INLINE floats opacities_from_eye(
    const floats x,
    const floats y,
    const floats z,
    const uint first,
    const uint count,
    global const float *opacity) {
    const floats distance = sqrt(square(x, y, z));
    floats basis[OPACITIES], seen = 0.0f;
    SH_BASIS(basis, x / distance, y / distance, z / distance)
    basis[0] = 1.0f;
    float learned[LANES];
    GPU_UNROLLED_FOR (uint k = 0; k < OPACITIES; k++) {
        for (uint j = 0; j < LANES; j++)
            learned[j] = opacity[OPACITIES * (size_t)(first + min(j, count - 1)) + k];
        seen += basis[k] * LANES_FROM(learned);
    }
    return BOUNDED(seen, (floats)(0.0f), (floats)(1.0f));
}

// Reads the grid indices, offsets and opacities of `count` points from `first` on, writes what
// project_grid says of them and returns the sum of their tiles.
ALWAYS_INLINE uint project_vertices(
    const Camera *cam,
    const uint first,
    const uint count,
    global const float *grid,
    global const uint *point_id,
    const float radius,
    global const float *cloud_offset,
    global const float *opacity,
    global uint *point_record,
    global uint *point_count) {
    // most points of a crop lie beside it
    const uint one = point_id[first], other = point_id[first + count - 1];
    bool misses =
        LANES > 1 && (one ^ other) >> 3 * BRICK_BITS == 0 && brick_misses(cam, grid, one, radius);
    Footprints f;
    ints in_image;
    floats px, py, pz;
    if (!misses) {
        uint id[LANES];
        float offset[3 + FORM][LANES];
        for (uint j = 0; j < LANES; j++) {
            const size_t row = first + min(j, count - 1);
            id[j] = point_id[row];
            GPU_UNROLLED_FOR (uint k = 0; k < 3 + FORM; k++)
                offset[k][j] = cloud_offset[OFFSETS * row + k];
        }
        // as grid_vertex() has it
        const uints ids = LANES_FROM(id);
        uints x = ids >> 3 * BRICK_BITS;
        uints y = divide(&x, bricks(grid[4]));
        const uints z = divide(&y, bricks(grid[5]));
        const uints i = BRICK * x + (ids & (BRICK - 1));
        const uints j = BRICK * y + (ids >> BRICK_BITS & (BRICK - 1));
        const uints k = BRICK * z + (ids >> 2 * BRICK_BITS & (BRICK - 1));
        floats form[FORM];
        GPU_UNROLLED_FOR (uint number = 0; number < FORM; number++) {
            const floats learned = LANES_FROM(offset[3 + number]);
            form[number] = radius * (number < LOGS ? exp(learned) : learned);
        }
        px = grid[0] + grid[3] * (LANED(convert_float)(i) + LANES_FROM(offset[0]));
        py = grid[1] + grid[3] * (LANED(convert_float)(j) + LANES_FROM(offset[1]));
        pz = grid[2] + grid[3] * (LANED(convert_float)(k) + LANES_FROM(offset[2]));
        misses = !project(cam, px, py, pz, LOGS == 1 ? form[0] : radius, form, &f, &in_image);
    }
    if (misses || !ANY_LANE(in_image)) {
        for (uint j = 0; j < count; j++)
            point_count[first + j] = 0;
        return 0;
    }
    const floats seen = opacities_from_eye(
        px - cam->eye.x, py - cam->eye.y, pz - cam->eye.z, first, count, opacity);
    uint words[RECORD][LANES], sum = 0;
    int tiles[LANES];
    LANES_INTO(words[0], LANED(as_uint)(f.x));
    LANES_INTO(words[1], LANED(as_uint)(f.y));
    LANES_INTO(words[2], LANED(as_uint)(f.z));
    LANES_INTO(words[3], LANED(as_uint)(f.t));
    LANES_INTO(words[4], LANED(as_uint)(f.size));
    LANES_INTO(words[5], LANED(as_uint)(seen));
    LANES_INTO(
        words[6], LANED(as_uint)(f.first[0] / SUPERSAMPLING | f.first[1] / SUPERSAMPLING << 16));
    LANES_INTO(
        words[7], LANED(as_uint)(f.last[0] / SUPERSAMPLING | f.last[1] / SUPERSAMPLING << 16));
#if RECORD > 8
    for (uint k = 0; k < 3; k++)
        LANES_INTO(words[8 + k], LANED(as_uint)(f.W[k]));
    for (uint k = 0; k < 5; k++)
        LANES_INTO(words[11 + k], LANED(as_uint)(k < 2 ? f.centre[k] : (floats)(0.0f)));
#endif
    LANES_INTO(tiles, count_tiles(&f, in_image));
    for (uint j = 0; j < count; j++) {
        point_count[first + j] = tiles[j];
        sum = add_sat(sum, (uint)tiles[j]);
        if (tiles[j] == 0) continue;
        uint record[RECORD];
        GPU_UNROLLED_FOR (uint k = 0; k < RECORD; k++)
            record[k] = words[k][j];
        for (uint k = 0; k < RECORD; k += 8)
            vstore8(vload8(0, record + k), 0, point_record + RECORD * (size_t)(first + j) + k);
    }
    return sum;
}

// GROUP work-items per block of BLOCK points: read their grid indices, offsets and opacities, write
// the numbers of tiles that they may cover and the sum of these and, of points that may cover any,
// their records.
kernel void project_grid(
    const uint n,                      // points
    global const float *camera,        // (21) camera.h
    global const float *grid,          // (8) grid.h
    global const uint *point_id,       // (N)
    const float radius,                // of a point without offsets, world units
    global const float *cloud_offset,  // (N, OFFSETS) cloud.h
    global const float *opacity,       // (N, OPACITIES) cloud.h
    global uint *point_record,         // (N, RECORD) footprint.h
    global uint *point_count,          // (N)
    global uint *block_sum)            // ((N+BLOCK-1)/BLOCK) of point_count
{
    SHARED(uint, shared, 2 * GROUP);
    const uint begin = GROUP_ID * BLOCK, end = min(n, begin + BLOCK);
    if (begin >= n) return;
    const Camera cam = camera_load(camera);
    uint sum = 0, total;
    for (uint first = begin + MEMBER * LANES; first < end; first += GROUP * LANES)
        sum = add_sat(
            sum, project_vertices(
                     &cam, first, min((uint)LANES, end - first), grid, point_id, radius,
                     cloud_offset, opacity, point_record, point_count));
    group_scan(sum, shared, &total);
    if (MEMBER == 0) block_sum[GROUP_ID] = total;
}
