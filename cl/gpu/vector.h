// Loads and stores of 4 neighbouring values as one vector, of which the last ones may not exist.
#ifndef PP_GPU_VECTOR_H
#define PP_GPU_VECTOR_H

// The 4 values at p, of which `count` exist; the others read as 0.
static inline float4 load4(global const float *p, const int count) {
    if (count >= 4) return vload4(0, p);
    return (float4)(p[0], count > 1 ? p[1] : 0.0f, count > 2 ? p[2] : 0.0f, 0.0f);
}

// Write the first `count` of 4 values to p.
static inline void store4(const float4 value, global float *p, const int count) {
    p[0] = value.x;
    if (count > 1) p[1] = value.y;
    if (count > 2) p[2] = value.z;
    if (count > 3) p[3] = value.w;
}

#endif
