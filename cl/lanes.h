// Sixteen neighbouring channels as one vector, where the channel count need not be a multiple of 16.
#ifndef PP_LANES_H
#define PP_LANES_H

// p[0..15]; lanes from n on are 0 and not read.
inline float16 load_lanes(global const float *p, const int n) {
    if (n >= 16)
        return vload16(0, p);
    float lane[16];
    for (int i = 0; i < 16; i++)
        lane[i] = i < n ? p[i] : 0.0f;
    return vload16(0, lane);
}

// Writes p[0..15]; lanes from n on are left alone.
inline void store_lanes(const float16 v, global float *p, const int n) {
    if (n >= 16) {
        vstore16(v, 0, p);
        return;
    }
    float lane[16];
    vstore16(v, 0, lane);
    for (int i = 0; i < n; i++)
        p[i] = lane[i];
}

#endif
