// Pairs: every fragment of a point in a pixel, written point by point, each with a key (depth << 32
// | pair). The keys then become lists, one for each pixel, sorted by depth, then by pair and so by
// point: lists_by_bucket.cl on CPUs, lists_by_key.cl on GPUs, where a key at first has its place in
// the list, in any order, instead of the pair.
#include "common.h"
#include "raster/footprint.h"
#include "scan.h"

#if LANES > 1
#define BESIDE_DEPTH(pixel, pair) (pair)
#else
#define BESIDE_DEPTH(pixel, pair) atomic_inc(&pixel_count[pixel])
#endif

// Pixels of a box that are tested before their fragments are written, at most 32 (bits of a uint).
// With fewer, writing alternates more often between the pairs of 16 points, which lie far apart.
#define CELLS (LANES > 1 ? 32 : 1)

// Reads the footprints of the points from `first` on, of which `count` exist; the others have empty
// boxes.
ALWAYS_INLINE Footprints footprints_load(
    const uint first,
    const uint count,
    global const float4 *point_camera,
    global const float *point_shape,
    global const ushort4 *point_box) {
    Footprints f;
    float place[4][LANES], shape[SHAPE][LANES];
    for (uint j = 0; j < LANES; j++) {
        const uint i = first + min(j, count - 1);
        const float4 at = point_camera[i];
        const int4 box = j < count ? convert_int4(point_box[i]) : (int4)(1, 1, 0, 0);
        place[0][j] = at.x;
        place[1][j] = at.y;
        place[2][j] = at.z;
        place[3][j] = at.w;
        GPU_UNROLLED_FOR (uint k = 0; k < SHAPE; k++)
            shape[k][j] = point_shape[SHAPE * i + k];
        f.box[0][j] = box.x;
        f.box[1][j] = box.y;
        f.box[2][j] = box.z;
        f.box[3][j] = box.w;
    }
    f.x = LANES_FROM(place[0]);
    f.y = LANES_FROM(place[1]);
    f.z = LANES_FROM(place[2]);
    f.t = LANES_FROM(place[3]);
    GPU_UNROLLED_FOR (uint k = 0; k < SHAPE; k++)
        f.shape[k] = LANES_FROM(shape[k]);
    footprints_measure(&f);
    return f;
}

// Finds the fragments of `count` points from `first` on again (project.cl counted them), and writes
// them as pairs from `offset` on.
//
// A compiler that rounds otherwise here than in project.cl finds one fragment more or less of a
// point in a million: one too many is left out, one that is missing becomes a pair without weight.
ALWAYS_INLINE void fill(
    const Camera *cam,
    const uint first,
    const uint count,
    uint offset,
    global const float4 *point_camera,
    global const float *point_shape,
    global const ushort4 *point_box,
    global const uint *point_count,
    global uint *pair_pixel,
    global uint *pair_point_falloff,
    global ulong *point_key,
    global volatile uint *pixel_count) {
    const Footprints f = footprints_load(first, count, point_camera, point_shape, point_box);
    const Rim rim = footprints_rim(cam, &f);
    const int width = cam->width / SIDE;
    // of each point: its next pair, where they end, the first pixel of its box
    uint next[LANES], end[LANES], corner[LANES];
    for (uint j = 0; j < count; j++) {
        next[j] = offset;
        offset = end[j] = offset + point_count[first + j];
        corner[j] = f.box[1][j] * width + f.box[0][j];
    }
    int row = 0, column = 0;
    while (row < f.rows) {
        // first a few pixels of all points, then what each point covers: its pairs lie together
        float falloff[CELLS][LANES], depth[CELLS][LANES];
        uint beside[CELLS], fragments[LANES];
        uints found = 0;
        for (uint k = 0; k < CELLS && row < f.rows; k++) {
            const Coverage c = footprints_test(&f, &rim, column, row);
            found |= select((uints)(0), (uints)(1u << k), c.covers);
            LANES_INTO(falloff[k], c.falloff);
            LANES_INTO(depth[k], c.depth);
            beside[k] = row * width + column;
            if (++column == f.columns) {
                column = 0;
                row++;
            }
        }
        LANES_INTO(fragments, found);
        for (uint j = 0; j < count; j++)
            for (uint left = fragments[j]; left && next[j] < end[j]; left &= left - 1) {
                const uint k = 31 - clz(left & -left), pair = next[j]++;
                const uint pixel = corner[j] + beside[k];
                pair_pixel[pair] = pixel;
                STORE_FRAGMENT(first + j, falloff[k][j], pair, pair_point_falloff);
                point_key[pair] = upsample(as_uint(depth[k][j]), BESIDE_DEPTH(pixel, pair));
            }
    }
    for (uint j = 0; j < count; j++)
        for (uint pair = next[j]; pair < end[j]; pair++) {
            const float depth = point_camera[first + j].w;
            pair_pixel[pair] = corner[j];
            STORE_FRAGMENT(first + j, 0.0f, pair, pair_point_falloff);
            point_key[pair] = upsample(as_uint(depth), BESIDE_DEPTH(corner[j], pair));
        }
}

// GROUP work-items per block of BLOCK points: find where the pairs of each begin and, where all have
// room, write them, and count the view for points that have any.
kernel void pairs_fill(
    const uint n,                       // points
    const uint p,                       // capacity, in pairs
    const int is_counted,               // 0: times_seen is not touched
    global const float *camera,         // (21) camera.h
    global const float4 *point_camera,  // (N, 4) x, y, z, t
    global const float *point_shape,    // (N, SHAPE) footprint.h
    global const ushort4 *point_box,    // (N, 4) first x, first y, last x, last y
    global const uint *point_count,     // (N) fragments
    global const uint *block_sum,       // ((N+BLOCK-1)/BLOCK) of them
    global uint *point_offset,          // (N+1) first pair of each point
    global uint *pair_pixel,            // (P)
    global uint *pair_point_falloff,    // (P, ?) point, with one sample bits of d in [0, 1]
    global ulong *point_key,            // (P) depth << 32 | pair, on GPUs place, by point
    global float *times_seen,           // (N) accumulates, NULL if not is_counted
    global volatile uint *pixel_count)  // (?) (HW) accumulates on GPUs, else untouched
{
    SHARED(uint, shared, 2 * GROUP);
    const uint begin = GROUP_ID * BLOCK, end = min(n, begin + BLOCK);
    if (begin >= n) return;
    SUM_BEFORE(GROUP_ID, block_sum, shared, behind)  // where the pairs of the points so far end
    SUM_BEFORE((n + BLOCK - 1) / BLOCK, block_sum, shared, all)
    const Camera cam = camera_load(camera);
    for (uint run = begin; run < end; run += GROUP * LANES) {
        const uint first = run + MEMBER * LANES,
                   count = first < end ? min((uint)LANES, end - first) : 0;
        uint fragments = 0, of_run;
        for (uint j = 0; j < count; j++)
            fragments = add_sat(fragments, point_count[first + j]);
        const uint offset = add_sat(behind, group_scan(fragments, shared, &of_run));
        behind = add_sat(behind, of_run);
        uint next = offset;
        for (uint j = 0; j < count; j++) {
            point_offset[first + j] = next;
            next = add_sat(next, point_count[first + j]);
        }
        if (fragments == 0 || all > p) continue;
        for (uint j = 0; is_counted && j < count; j++)
            if (point_count[first + j] > 0) times_seen[first + j] += 1.0f;
        fill(
            &cam, first, count, offset, point_camera, point_shape, point_box, point_count,
            pair_pixel, pair_point_falloff, point_key, pixel_count);
    }
    if (end == n && MEMBER == 0) point_offset[n] = behind;
}
