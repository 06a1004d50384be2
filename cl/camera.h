// A pinhole camera read from one buffer of 20 floats (docs/conventions.md); pp_cl/scene/camera.py
// writes it.
#ifndef PP_CAMERA_H
#define PP_CAMERA_H

#define CAMERA_FLOATS 20

typedef struct {
    float3 right, down, forward;  // camera axes in world coordinates
    float3 eye;
    float fx, fy, cx, cy;  // pixels; the centre of pixel (x, y) is (x + 0.5, y + 0.5)
    float near, far;       // Euclidean distance from the eye
    int width, height;
} Camera;

static inline Camera camera_load(global const float *c) {
    Camera k;
    k.right = (float3)(c[0], c[1], c[2]);
    k.down = (float3)(c[3], c[4], c[5]);
    k.forward = (float3)(c[6], c[7], c[8]);
    k.eye = (float3)(c[9], c[10], c[11]);
    k.fx = c[12];
    k.fy = c[13];
    k.cx = c[14];
    k.cy = c[15];
    k.near = c[16];
    k.far = c[17];
    k.width = (int)c[18];
    k.height = (int)c[19];
    return k;
}

// Unit ray through the centre of pixel (x, y), in camera axes.
static inline float3 camera_ray(const Camera *k, const int x, const int y) {
    return normalize((float3)((x + 0.5f - k->cx) / k->fx, (y + 0.5f - k->cy) / k->fy, 1.0f));
}

#endif
