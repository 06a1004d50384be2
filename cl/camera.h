// A pinhole camera read from one buffer of 21 floats (docs/conventions.md); pp_cl/engine/camera.py
// writes it. World coordinates count from a centre near the points, as in grid.h.
#ifndef PP_CAMERA_H
#define PP_CAMERA_H

typedef struct {
    float3 right, down, forward;  // camera axes in world coordinates
    float3 eye;
    float fx, fy, cx, cy;  // pixels; the centre of pixel (x, y) is (x + 0.5, y + 0.5)
    float near, far;       // Euclidean distance from the eye
    int width, height;
    float samples;  // of Gaussians: pixels of a viewer's rendering, each way, whose mean a pixel is
} Camera;

static inline Camera camera_load(global const float *c) {
    Camera cam;
    cam.right = (float3)(c[0], c[1], c[2]);
    cam.down = (float3)(c[3], c[4], c[5]);
    cam.forward = (float3)(c[6], c[7], c[8]);
    cam.eye = (float3)(c[9], c[10], c[11]);
    cam.fx = c[12];
    cam.fy = c[13];
    cam.cx = c[14];
    cam.cy = c[15];
    cam.near = c[16];
    cam.far = c[17];
    cam.width = (int)c[18];
    cam.height = (int)c[19];
    cam.samples = c[20];
    return cam;
}

// Unit ray through the centre of pixel (x, y), in camera axes.
static inline float3 camera_ray(const Camera *cam, const int x, const int y) {
    return normalize(
        (float3)((x + 0.5f - cam->cx) / cam->fx, (y + 0.5f - cam->cy) / cam->fy, 1.0f));
}

#endif
