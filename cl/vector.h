// Loads and stores of 16 neighbouring values as one vector, of which the last ones may not exist.
#ifndef PP_VECTOR_H
#define PP_VECTOR_H

// The 16 values at p, of which `count` exist; the others read as 0.
static inline float16 load16(global const float *p, const int count) {
    if (count >= 16) return vload16(0, p);
    if (count <= 4) {  // an image's channels: without the detour through memory
        float16 few = 0.0f;
        few.s0 = p[0];
        few.s1 = count > 1 ? p[1] : 0.0f;
        few.s2 = count > 2 ? p[2] : 0.0f;
        few.s3 = count > 3 ? p[3] : 0.0f;
        return few;
    }
    float x[16];
    for (int i = 0; i < 16; i++)
        x[i] = i < count ? p[i] : 0.0f;
    return vload16(0, x);
}

// Write the first `count` of 16 values to p.
static inline void store16(const float16 value, global float *p, const int count) {
    if (count >= 16) {
        vstore16(value, 0, p);
        return;
    }
    float x[16];
    vstore16(value, 0, x);
    for (int i = 0; i < count; i++)
        p[i] = x[i];
}

#endif
