// Images of the demo's object (demo_object.h): brass, lacquer and inlaid wood, sphere-traced
// (Hart 1996) with 4x4 rays a pixel, LANES at a time; and its distance field for the
// mesh.
#include "camera.h"
#include "common.h"
#include "scene/demo_object.h"
#include "lanes.h"

#define MARCH_STEPS 96
#define SHADOW_STEPS 16
#define HIT 4e-4f  // a quarter of the space between the rays of a 400-pixel image, at the object

// Unit directions of the two lights.
#define KEY ((float3)(0.40f, -0.52f, 0.7547f))
#define FILL ((float3)(-0.80f, 0.45f, 0.3969f))

static inline Vectors scene_normal(const Vectors p) {
    const float h = 5e-4f;
    Vectors n = {0};
    for (int i = 0; i < 4; i++) {  // the corners of a tetrahedron
        const float x = i & 1 ? 1 : -1, y = i & 2 ? 1 : -1, z = x * y;
        const floats d = scene_distance((Vectors){p.x + h * x, p.y + h * y, p.z + h * z});
        n = (Vectors){n.x + d * x, n.y + d * y, n.z + d * z};
    }
    return normalize_lanes(n);
}

// Share of the key light that reaches p: a soft shadow, its penumbra from the closest approach to
// another part. Anything in lanes that are not `asked`.
static inline floats key_visibility(const Vectors p, const ints asked) {
    floats lit = 1.0f, t = 0.02f;
    for (int step = 0; step < SHADOW_STEPS && ANY_LANE(asked & (lit > 0.0f)); step++) {
        const floats d =
            scene_distance((Vectors){p.x + t * KEY.x, p.y + t * KEY.y, p.z + t * KEY.z});
        lit = min(lit, 12.0f * d / t);
        t += clamp(d, 0.02f, 0.3f);
    }
    return max(lit, 0.0f);
}

// Share of the surroundings that p sees, from the distances along its normal n.
static inline floats openness(const Vectors p, const Vectors n) {
    const floats near = scene_distance(advance(p, n, 0.05f)),
                 far = scene_distance(advance(p, n, 0.15f));
    return clamp(0.4f + 6.0f * near + 2.0f * far, 0.0f, 1.0f);
}

static inline Vectors mix_colours(const float3 a, const float3 b, const floats share) {
    return (Vectors){
        a.x + (b.x - a.x) * share, a.y + (b.y - a.y) * share, a.z + (b.z - a.z) * share};
}

// `colour`, replaced in the lanes `where` by a mixture of a and b.
static inline Vectors
paint(const Vectors colour, const ints where, const float3 a, const float3 b, const floats share) {
    const Vectors c = mix_colours(a, b, share);
    return (Vectors){
        select(colour.x, c.x, where), select(colour.y, c.y, where), select(colour.z, c.z, where)};
}

// 0 and 1 in turn, in cells of size 1.
static inline floats chequer(const floats a, const floats b) {
    const floats cell = floor(a) + floor(b);
    return cell - 2.0f * floor(0.5f * cell);
}

// Linear colour of the part nearest to each place, and which places are metal.
static inline Vectors surface_colour(const Vectors position, ints *metal) {
    floats d[PARTS];
    parts(position, d);
    const floats nearest = min(min(min(d[BASE], d[BRASS]), min(d[BAND], d[SPOKES])), d[GLOBE]);
    const ints brass = d[BRASS] <= nearest, band = d[BAND] <= nearest;
    const ints spokes = d[SPOKES] <= nearest, globe = d[GLOBE] <= nearest;
    const Vectors p = {position.x, position.y, position.z - GLOBE_Z};

    const floats grain = 0.5f + 0.5f * sin(60.0f * p.x + 5.0f * sin(7.0f * p.y));
    Vectors colour =
        mix_colours((float3)(0.15f, 0.05f, 0.02f), (float3)(0.32f, 0.13f, 0.05f), grain);

    const floats from_axis = length_lanes(p.x, p.y);
    const floats inlaid = chequer(from_axis / 0.06f, atan2pi(p.y, p.x) * 18.0f);
    const ints inlay = fabs(from_axis - 0.36f) < 0.06f;
    colour =
        paint(colour, inlay, (float3)(0.03f, 0.02f, 0.02f), (float3)(0.80f, 0.72f, 0.55f), inlaid);

    const floats u = dot_axis(p, MERIDIAN), v = dot_axis(p, WHEEL_V);
    const floats degrees = atan2pi(p.z, p.y * MERIDIAN.x - p.x * MERIDIAN.y) * 60.0f;
    const ints scale = band & (fabs(u) > 0.022f);
    const floats engraved = select((floats)0.0f, chequer(degrees, 0.0f), scale);
    colour = paint(
        colour, brass | band, (float3)(0.95f, 0.64f, 0.25f), (float3)(0.10f, 0.05f, 0.03f),
        engraved);

    const floats striped = chequer(length_lanes(u, v) / 0.055f, 0.0f);
    colour = paint(
        colour, spokes, (float3)(0.62f, 0.02f, 0.03f), (float3)(0.85f, 0.80f, 0.70f), striped);

    const floats tiled = chequer(dot_axis(p, WHEEL) * (5.0f / GLOBE_RADIUS), atan2pi(v, u) * 10.0f);
    colour =
        paint(colour, globe, (float3)(0.01f, 0.10f, 0.22f), (float3)(0.80f, 0.68f, 0.42f), tiled);
    *metal = brass | band;
    return colour;
}

// What a mirror shows in `direction`: ground below a soft horizon, sky, and a lamp around the key
// light.
static inline Vectors environment(const Vectors direction) {
    const floats above = smoothstep(-0.25f, 0.25f, direction.z);
    const floats lamp = 3.5f * smoothstep(0.82f, 0.97f, dot_axis(direction, KEY));
    const Vectors seen =
        mix_colours((float3)(0.20f, 0.16f, 0.14f), (float3)(0.80f, 0.82f, 0.86f), above);
    return (Vectors){seen.x + lamp, seen.y + lamp, seen.z + lamp};
}

// Display value of a linear one: the square root is close to sRGB.
static inline floats displayed(const floats linear) {
    return sqrt(clamp(linear, 0.0f, 1.0f));
}

// Displayed colour of places p that were `hit`, seen along unit rays: two lights, the environment's reflection,
// Schlick's Fresnel term.
static inline Vectors shade(const Vectors p, const Vectors ray, const ints hit) {
    ints metal;
    const Vectors colour = surface_colour(p, &metal);
    const Vectors n = scene_normal(p);
    const floats towards = max(dot_axis(n, KEY), 0.0f), open = openness(p, n);
    const floats lit = key_visibility(advance(p, n, 4e-3f), hit & (towards > 0.0f));
    const floats facing = max(-dot_lanes(n, ray), 0.0f);
    const Vectors reflected = advance(ray, n, 2.0f * facing);

    const floats soft = open * (0.30f + 0.15f * n.z + 0.22f * max(dot_axis(n, FILL), 0.0f));
    const floats diffuse = soft + 0.85f * lit * towards;
    const floats grazing = 1.0f - facing, grazing2 = grazing * grazing;
    const floats fresnel = grazing2 * grazing2 * grazing;
    const Vectors mirror = environment(reflected);

    // A metal mirrors in its own colour; lacquer has 6 percent of clear reflection on top of its
    // colour.
    const floats matte = select((floats)1.0f, (floats)0.25f, metal);
    const floats clear = open * select(0.06f + 0.94f * fresnel, 0.3f * fresnel, metal);
    const floats tinted = open * select((floats)0.0f, (floats)0.75f, metal);
    return (Vectors){
        displayed(colour.x * (matte * diffuse + tinted * mirror.x) + clear * mirror.x),
        displayed(colour.y * (matte * diffuse + tinted * mirror.y) + clear * mirror.y),
        displayed(colour.z * (matte * diffuse + tinted * mirror.z) + clear * mirror.z)};
}

// One work-item per pixel: traces 4x4 rays, writes the mean displayed colour of those that hit, and
// their share as alpha.
kernel void render_demo(
    const uint width,
    const uint height,
    global const float *camera,  // (21) cl/camera.h
    global uchar4 *image)        // (height, width, 4) straight RGBA
{
    const uint x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const Camera cam = camera_load(camera);
    const Vectors eye = {cam.eye.x, cam.eye.y, cam.eye.z};
    const Vectors from_bound = {eye.x, eye.y, eye.z - BOUND_Z};
    float3 sum = 0.0f;
    float hits = 0.0f;
    for (uint first = 0; first < 16; first += LANES) {
        const uints number = first + LANE;
        const floats across = LANED(convert_float)(2 * (number & 3) + 1) / 8.0f;
        const floats along = LANED(convert_float)(2 * (number >> 2) + 1) / 8.0f;
        const floats right = (x + across - cam.cx) / cam.fx, down = (y + along - cam.cy) / cam.fy;
        const Vectors ray = normalize_lanes((Vectors){
            cam.right.x * right + cam.down.x * down + cam.forward.x,
            cam.right.y * right + cam.down.y * down + cam.forward.y,
            cam.right.z * right + cam.down.z * down + cam.forward.z});

        const floats middle = -dot_lanes(from_bound, ray);
        const floats chord =
            BOUND_RADIUS * BOUND_RADIUS - dot_lanes(from_bound, from_bound) + middle * middle;
        const floats end = middle + sqrt(max(chord, 0.0f));
        floats t = middle - sqrt(max(chord, 0.0f));
        ints marching = chord > 0.0f, hit = 0;
        for (int step = 0; step < MARCH_STEPS && ANY_LANE(marching); step++) {
            const floats d = scene_distance(advance(eye, ray, t));
            hit |= marching & (d < HIT);
            t = select(t, t + d, marching & ~hit);
            marching &= ~hit & (t < end);
        }
        if (!ANY_LANE(hit)) continue;
        const Vectors colour = shade(advance(eye, ray, t), ray, hit);
        const floats weight = select((floats)0.0f, (floats)1.0f, hit);
        hits += SUM_LANES(weight);
        sum += (float3)(SUM_LANES(weight * colour.x), SUM_LANES(weight * colour.y),
                        SUM_LANES(weight * colour.z));
    }
    image[y * width + x] =
        hits == 0.0f ? (uchar4)(0)
                     : convert_uchar4_sat_rte(255.0f * (float4)(sum / hits, hits / 16.0f));
}

// One work-item per LANES vertices of a grid, x first: writes their distances to the object, which
// are negative inside.
kernel void demo_distances(
    const uint n,              // vertices
    global const float *grid,  // (8) cl/grid.h
    global float *distances)   // (n)
{
    const uint first = LANES * get_global_id(0), nx = grid[4], ny = grid[5];
    if (first >= n) return;
    float x[LANES], y[LANES], z[LANES];
    for (uint lane = 0; lane < LANES; lane++) {
        const uint vertex = first + lane, row = vertex / nx;
        x[lane] = grid[0] + grid[3] * (vertex - row * nx);
        y[lane] = grid[1] + grid[3] * (row % ny);
        z[lane] = grid[2] + grid[3] * (row / ny);
    }
    const Vectors p = {LANES_FROM(x), LANES_FROM(y), LANES_FROM(z)};
    store_lanes(scene_distance(p), distances + first, n - first);
}
