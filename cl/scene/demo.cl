// Images of the demo's object (demo_object.h): brass, lacquer and inlaid wood, sphere-traced
// (Hart 1996) with 4x4 rays a pixel, one in each lane of a float16; and its distance field for the
// mesh.
#include "camera.h"
#include "common.h"
#include "scene/demo_object.h"
#include "grid.h"
#include "reduce.h"
#include "vector.h"

#define MARCH_STEPS 96
#define SHADOW_STEPS 16
#define HIT 4e-4f  // a quarter of the space between the rays of a 400-pixel image, at the object

// Unit directions of the two lights.
#define KEY ((float3)(0.40f, -0.52f, 0.7547f))
#define FILL ((float3)(-0.80f, 0.45f, 0.3969f))

static inline Vector16 scene_normal(const Vector16 p) {
    const float h = 5e-4f;
    Vector16 n = {0};
    for (int i = 0; i < 4; i++) {  // the corners of a tetrahedron
        const float x = i & 1 ? 1 : -1, y = i & 2 ? 1 : -1, z = x * y;
        const float16 d = scene_distance((Vector16){p.x + h * x, p.y + h * y, p.z + h * z});
        n = (Vector16){n.x + d * x, n.y + d * y, n.z + d * z};
    }
    return normalize_lanes(n);
}

// Share of the key light that reaches p: a soft shadow, its penumbra from the closest approach to
// another part.
static inline float16 key_visibility(const Vector16 p) {
    float16 lit = 1.0f, t = 0.02f;
    for (int step = 0; step < SHADOW_STEPS; step++) {
        const float16 d =
            scene_distance((Vector16){p.x + t * KEY.x, p.y + t * KEY.y, p.z + t * KEY.z});
        lit = min(lit, 12.0f * d / t);
        t += clamp(d, 0.02f, 0.3f);
    }
    return max(lit, 0.0f);
}

// Share of the surroundings that p sees, from the distances along its normal n.
static inline float16 openness(const Vector16 p, const Vector16 n) {
    const float16 near = scene_distance(advance(p, n, 0.05f)),
                  far = scene_distance(advance(p, n, 0.15f));
    return clamp(0.4f + 6.0f * near + 2.0f * far, 0.0f, 1.0f);
}

static inline Vector16 mix_colours(const float3 a, const float3 b, const float16 share) {
    return (Vector16){
        a.x + (b.x - a.x) * share, a.y + (b.y - a.y) * share, a.z + (b.z - a.z) * share};
}

// `colour`, replaced in the lanes `where` by a mixture of a and b.
static inline Vector16 paint(
    const Vector16 colour,
    const int16 where,
    const float3 a,
    const float3 b,
    const float16 share) {
    const Vector16 c = mix_colours(a, b, share);
    return (Vector16){
        select(colour.x, c.x, where), select(colour.y, c.y, where), select(colour.z, c.z, where)};
}

// 0 and 1 in turn, in cells of size 1.
static inline float16 chequer(const float16 a, const float16 b) {
    const float16 cell = floor(a) + floor(b);
    return cell - 2.0f * floor(0.5f * cell);
}

// Linear colour of the part nearest to each place, and which places are metal.
static inline Vector16 surface_colour(const Vector16 position, int16 *metal) {
    float16 d[PARTS];
    parts(position, d);
    const float16 nearest = min(min(min(d[BASE], d[BRASS]), min(d[BAND], d[SPOKES])), d[GLOBE]);
    const int16 brass = d[BRASS] <= nearest, band = d[BAND] <= nearest;
    const int16 spokes = d[SPOKES] <= nearest, globe = d[GLOBE] <= nearest;
    const Vector16 p = {position.x, position.y, position.z - GLOBE_Z};

    const float16 grain = 0.5f + 0.5f * sin(60.0f * p.x + 5.0f * sin(7.0f * p.y));
    Vector16 colour =
        mix_colours((float3)(0.15f, 0.05f, 0.02f), (float3)(0.32f, 0.13f, 0.05f), grain);

    const float16 from_axis = length_lanes(p.x, p.y);
    const float16 inlaid = chequer(from_axis / 0.06f, atan2pi(p.y, p.x) * 18.0f);
    const int16 inlay = fabs(from_axis - 0.36f) < 0.06f;
    colour =
        paint(colour, inlay, (float3)(0.03f, 0.02f, 0.02f), (float3)(0.80f, 0.72f, 0.55f), inlaid);

    const float16 u = dot_axis(p, MERIDIAN), v = dot_axis(p, WHEEL_V);
    const float16 degrees = atan2pi(p.z, p.y * MERIDIAN.x - p.x * MERIDIAN.y) * 60.0f;
    const int16 scale = band & (fabs(u) > 0.022f);
    const float16 engraved = select((float16)0.0f, chequer(degrees, 0.0f), scale);
    colour = paint(
        colour, brass | band, (float3)(0.95f, 0.64f, 0.25f), (float3)(0.10f, 0.05f, 0.03f),
        engraved);

    const float16 striped = chequer(length_lanes(u, v) / 0.055f, 0.0f);
    colour = paint(
        colour, spokes, (float3)(0.62f, 0.02f, 0.03f), (float3)(0.85f, 0.80f, 0.70f), striped);

    const float16 tiled =
        chequer(dot_axis(p, WHEEL) * (5.0f / GLOBE_RADIUS), atan2pi(v, u) * 10.0f);
    colour =
        paint(colour, globe, (float3)(0.01f, 0.10f, 0.22f), (float3)(0.80f, 0.68f, 0.42f), tiled);
    *metal = brass | band;
    return colour;
}

// What a mirror shows in `direction`: ground below a soft horizon, sky, and a lamp around the key
// light.
static inline Vector16 environment(const Vector16 direction) {
    const float16 above = smoothstep(-0.25f, 0.25f, direction.z);
    const float16 lamp = 3.5f * smoothstep(0.82f, 0.97f, dot_axis(direction, KEY));
    const Vector16 seen =
        mix_colours((float3)(0.20f, 0.16f, 0.14f), (float3)(0.80f, 0.82f, 0.86f), above);
    return (Vector16){seen.x + lamp, seen.y + lamp, seen.z + lamp};
}

// Display value of a linear one: the square root is close to sRGB.
static inline float16 displayed(const float16 linear) {
    return sqrt(clamp(linear, 0.0f, 1.0f));
}

// Displayed colour of places p seen along unit rays: two lights, the environment's reflection,
// Schlick's Fresnel term.
static inline Vector16 shade(const Vector16 p, const Vector16 ray) {
    int16 metal;
    const Vector16 colour = surface_colour(p, &metal);
    const Vector16 n = scene_normal(p);
    const float16 open = openness(p, n), lit = key_visibility(advance(p, n, 4e-3f));
    const float16 facing = max(-dot_lanes(n, ray), 0.0f);
    const Vector16 reflected = advance(ray, n, 2.0f * facing);

    const float16 soft = open * (0.30f + 0.15f * n.z + 0.22f * max(dot_axis(n, FILL), 0.0f));
    const float16 diffuse = soft + 0.85f * lit * max(dot_axis(n, KEY), 0.0f);
    const float16 grazing = 1.0f - facing, grazing2 = grazing * grazing;
    const float16 fresnel = grazing2 * grazing2 * grazing;
    const Vector16 mirror = environment(reflected);

    // A metal mirrors in its own colour; lacquer has 6 percent of clear reflection on top of its
    // colour.
    const float16 matte = select((float16)1.0f, (float16)0.25f, metal);
    const float16 clear = open * select(0.06f + 0.94f * fresnel, 0.3f * fresnel, metal);
    const float16 tinted = open * select((float16)0.0f, (float16)0.75f, metal);
    return (Vector16){
        displayed(colour.x * (matte * diffuse + tinted * mirror.x) + clear * mirror.x),
        displayed(colour.y * (matte * diffuse + tinted * mirror.y) + clear * mirror.y),
        displayed(colour.z * (matte * diffuse + tinted * mirror.z) + clear * mirror.z)};
}

// One work-item per pixel: traces 4x4 rays, writes the mean displayed colour of those that hit, and
// their share as alpha.
kernel void render_demo(
    const uint width,
    const uint height,
    global const float *camera,  // (20) cl/camera.h
    global uchar4 *image)        // (height, width, 4) straight RGBA
{
    const uint x = get_global_id(0), y = get_global_id(1);
    if (x >= width || y >= height) return;
    const Camera cam = camera_load(camera);
    const float16 across = (float16)(1, 3, 5, 7, 1, 3, 5, 7, 1, 3, 5, 7, 1, 3, 5, 7) / 8.0f;
    const float16 along = (float16)(1, 1, 1, 1, 3, 3, 3, 3, 5, 5, 5, 5, 7, 7, 7, 7) / 8.0f;
    const float16 right = (x + across - cam.cx) / cam.fx, down = (y + along - cam.cy) / cam.fy;
    const Vector16 ray = normalize_lanes((Vector16){
        cam.right.x * right + cam.down.x * down + cam.forward.x,
        cam.right.y * right + cam.down.y * down + cam.forward.y,
        cam.right.z * right + cam.down.z * down + cam.forward.z});
    const Vector16 eye = {cam.eye.x, cam.eye.y, cam.eye.z};

    const Vector16 from_bound = {eye.x, eye.y, eye.z - BOUND_Z};
    const float16 middle = -dot_lanes(from_bound, ray);
    const float16 chord =
        BOUND_RADIUS * BOUND_RADIUS - dot_lanes(from_bound, from_bound) + middle * middle;
    const float16 end = middle + sqrt(max(chord, 0.0f));
    float16 t = middle - sqrt(max(chord, 0.0f));
    int16 marching = chord > 0.0f, hit = 0;
    for (int step = 0; step < MARCH_STEPS && any(marching); step++) {
        const float16 d = scene_distance(advance(eye, ray, t));
        hit |= marching & (d < HIT);
        t = select(t, t + d, marching & ~hit);
        marching &= ~hit & (t < end);
    }
    if (!any(hit)) {
        image[y * width + x] = 0;
        return;
    }
    const Vector16 colour = shade(advance(eye, ray, t), ray);
    const float16 weight = select((float16)0.0f, (float16)1.0f, hit);
    const float hits = sum16(weight);
    const float3 shown =
        (float3)(dot16(weight, colour.x), dot16(weight, colour.y), dot16(weight, colour.z)) / hits;
    image[y * width + x] = convert_uchar4_sat_rte(255.0f * (float4)(shown, hits / 16.0f));
}

// One work-item per 16 vertices of a grid: writes their distances to the object, which are negative
// inside.
kernel void demo_distances(
    const uint n,              // vertices
    global const float *grid,  // (8) cl/grid.h
    global float *distances)   // (n)
{
    const uint first = 16 * get_global_id(0);
    if (first >= n) return;
    float x[16], y[16], z[16];
    for (uint lane = 0; lane < 16; lane++) {
        const float3 p = grid_position(grid, first + lane);
        x[lane] = p.x;
        y[lane] = p.y;
        z[lane] = p.z;
    }
    store16(
        scene_distance((Vector16){vload16(0, x), vload16(0, y), vload16(0, z)}), distances + first,
        n - first);
}
