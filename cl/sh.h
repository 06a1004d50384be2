// Real spherical harmonics of degrees 0 to 2 in the order and with the signs of PlenOctrees (Yu et
// al. 2021).
#ifndef PP_SH_H
#define PP_SH_H

#include "camera.h"

#define SH_0 0.28209479f   // 1 / (2 sqrt(pi))
#define SH_1 0.48860251f   // sqrt(3 / (4 pi))
#define SH_2A 1.09254843f  // sqrt(15 / (4 pi))
#define SH_2B 0.94617470f  // 3/4 sqrt(5 / pi)
#define SH_2C 0.31539157f  // 1/4 sqrt(5 / pi)
#define SH_2D 0.54627422f  // 1/4 sqrt(15 / pi)

// basis[0..8] of the unit vector (x, y, z), of numbers or lanes.
#define SH_BASIS(basis, x, y, z)                                                                   \
    {                                                                                              \
        basis[0] = SH_0;                                                                           \
        basis[1] = -SH_1 * (y);                                                                    \
        basis[2] = SH_1 * (z);                                                                     \
        basis[3] = -SH_1 * (x);                                                                    \
        basis[4] = SH_2A * (x) * (y);                                                              \
        basis[5] = -SH_2A * (y) * (z);                                                             \
        basis[6] = SH_2B * (z) * (z) - SH_2C;                                                      \
        basis[7] = -SH_2A * (x) * (z);                                                             \
        basis[8] = SH_2D * ((x) * (x) - (y) * (y));                                                \
    }

// basis[0..8] of the direction from the eye to a point. point: x, y, z in the camera's axes,
// distance.
static inline void sh_basis_of_point(global const float *camera, const float4 point, float *basis) {
    const Camera cam = camera_load(camera);
    const float3 c = point.xyz / point.w;
    const float3 d = c.x * cam.right + c.y * cam.down + c.z * cam.forward;
    SH_BASIS(basis, d.x, d.y, d.z)
}

// READ_AHEAD() of all coefficients of point i in sh_0, sh_1, sh_2a and sh_2b, up to DEGREE.
#define SH_READ_AHEAD(i)                                                                           \
    {                                                                                              \
        const size_t row = (i);                                                                    \
        READ_AHEAD(sh_0 + row);                                                                    \
        for (uint b = 0; b < 3; b++) {                                                             \
            if (DEGREE >= 1) READ_AHEAD(sh_1 + 3 * row + b);                                       \
            if (DEGREE >= 2) READ_AHEAD(sh_2a + 3 * row + b);                                      \
            if (DEGREE >= 2 && b < 2) READ_AHEAD(sh_2b + 2 * row + b);                             \
        }                                                                                          \
    }

#endif
