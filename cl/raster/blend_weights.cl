// The weights of Eq. (1) of the PlenopticPoints supplemental: each pixel's softmax over its hits,
// and what can be dropped.
//
// a_i = o_i z_i/gamma,  b_i = o_i d_i exp(a_i - M)/D,  b_0 = exp(EPS/gamma - M)/D with M the
// largest of EPS/gamma and the a_i where d_i > 0, and D the sum of all numerators. No exponent is
// positive, and D does not vanish: a_i > 1 means o_i > gamma, and a d_i > 0 is at least 6e-8;
// without any, b_0's numerator is at least 1/e.
//
// vec_type_hint: the vectors are written out; Intel's compiler would merge work-items into wider
// ones, up to 8 times slower.
#include "common.h"
#include "camera.h"
#include "reduce.h"

#define EPS 1e-6f    // depth of the background, as a z (Pulsar's background_normalized_depth)
#define BATCH 16     // hits of a pixel handled at once, one lane each
#define TAIL 0.125f  // share of tau for a bound of hits at the end that are not even weighed
// weight and slope of a hit that is no part of the picture; both signs tell it
#define DROPPED ((float2)(-0.0f))

// What Eq. (1) needs of a batch of hits. Lanes without a hit have opacity and closeness 0, hence no
// weight.
typedef struct {
    float16 opacity, closeness, z;
} Hits;

ALWAYS_INLINE Hits load_hits(
    const Camera *k,
    global const ulong *key,
    const uint count,
    global const uint2 *pair_source,
    global const float *opacity) {
    float o[BATCH] = {0.0f}, d[BATCH] = {0.0f}, depth[BATCH] = {0.0f};
    for (uint j = 0; j < count; j++) {
        const ulong entry = key[j];
        const uint2 source = pair_source[(uint)entry];
        o[j] = opacity[source.x];
        d[j] = as_float(source.y);
        depth[j] = as_float((uint)(entry >> 32));
    }
    Hits h;
    h.opacity = vload16(0, o);
    h.closeness = vload16(0, d);
    h.z = 1.0f - (vload16(0, depth) - k->near) / (k->far - k->near);
    return h;
}

// The weights of a pixel's hits [begin, stop) lie in `hit`; the weight `dropped` is gone already.
// Drops, from the back on, every hit with which `dropped` stays within tau; the others move up.
// Returns where they end.
static inline uint drop_hits(
    const uint begin,
    const uint stop,
    const float tau,
    float *dropped,
    global const ulong *pair_key,
    global float2 *pair_weight,
    global ulong *hit) {
    for (uint i = stop; i-- > begin;) {
        const float sum = *dropped + as_float((uint)(hit[i] >> 32));
        if (sum <= tau) {
            *dropped = sum;
            pair_weight[(uint)pair_key[i]] = DROPPED;
            hit[i] = NONE;
        }
    }
    uint kept = begin;
    for (uint i = begin; i < stop; i++)
        if ((uint)hit[i] != NONE) hit[kept++] = hit[i];
    return kept;
}

// One work-item per pixel: reads its hits, nearest first, writes their weights by pair and, with
// their points, by pixel.
//
// By pair: b, and b (1/o + z/gamma), finite at o = 0, whose sum with G.(f - F) is dL/do. A pair
// beyond the max_tracked nearest hits gets no gradient: -b and 0. Nor does one that is dropped, -0
// and -0:
// - by `least`, it and all behind it, if even o = d = 1 would give it less than this fraction of
//   what lies in front; differs from Pulsar: it looks only when its buffer is flushed;
// - by tau, from the back on, every hit with which the sum of all dropped weights stays within tau;
//   a tail so light that it need not be weighed is not in D, the background gets the weights of the
//   others. By pixel: the hits that are left, in their order, and behind them, where some were
//   dropped, no point and that sum.
kernel __attribute__((vec_type_hint(float16))) void weights_of_hits(
    const uint hw,           // pixels
    const uint max_tracked,  // hits of a pixel that get gradients
    const float gamma,
    const float least,                // 0: never stop
    const float tau,                  // 0: drop none
    global const float *camera,       // (20) camera.h
    global const uint *pixel_offset,  // (HW+1)
    global const ulong *pair_key,     // (P) depth << 32 | pair, sorted within a pixel
    global const uint2 *pair_source,  // (P, 2) point, bits of d
    global const float *opacity,      // (N)
    global float2 *pair_weight,       // (P, 2)
    global ulong *hit)                // (P) weight << 32 | point, in the order of the keys
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    const Camera k = camera_load(camera);
    const uint begin = pixel_offset[q], end = pixel_offset[q + 1];
    const int may_stop = least > 0.0f || tau > 0.0f;
    uint stop = end;
    float M = EPS / gamma, D = 1.0f;  // the background alone
    float dropped = 0.0f;
    Hits h;
    for (uint first = begin; first < stop; first += BATCH) {
        const uint count = min((uint)BATCH, end - first);
        h = load_hits(&k, pair_key + first, count, pair_source, opacity);
        const float16 a = h.opacity * h.z / gamma;
        const float m = fmax(M, max16(select((float16)(M), a, h.closeness > 0.0f)));
        D *= exp(M - m);
        M = m;
        float term[BATCH], best[BATCH];
        vstore16(h.opacity * h.closeness * exp(fmin(a - M, 0.0f)), 0, term);
        if (may_stop) vstore16(exp(fmax(h.z, 0.0f) / gamma - M), 0, best);
        for (uint j = 0; j < count && first + j < stop; j++) {
            // no less than all that follow
            const float rest = may_stop ? (end - first - j) * best[j] : 0.0f;
            if (may_stop && rest < TAIL * tau * D) {
                dropped = rest / D;
                stop = first + j;
            } else if (may_stop && best[j] < least / (1.0f - least) * D)
                stop = first + j;
            else
                D += term[j];
        }
    }
    for (uint first = begin; first < stop; first += BATCH) {
        const uint count = min((uint)BATCH, end - first);
        if (end - begin > BATCH) h = load_hits(&k, pair_key + first, count, pair_source, opacity);
        const float16 a = h.opacity * h.z / gamma;
        // b/o; a > M only where d = 0
        const float16 share = h.closeness * exp(fmin(a - M, 0.0f)) / D;
        float b[BATCH], slope[BATCH];
        vstore16(h.opacity * share, 0, b);
        vstore16(share * (1.0f + a), 0, slope);
        for (uint j = 0; j < min(count, stop - first); j++) {
            const uint i = first + j, pair = (uint)pair_key[i];
            pair_weight[pair] =
                i - begin < max_tracked ? (float2)(b[j], slope[j]) : (float2)(-b[j], 0.0f);
            hit[i] = upsample(as_uint(b[j]), pair_source[pair].x);
        }
    }
    for (uint i = stop; i < end; i++)
        pair_weight[(uint)pair_key[i]] = DROPPED;
    const uint kept =
        tau > 0.0f ? drop_hits(begin, stop, tau, &dropped, pair_key, pair_weight, hit) : stop;
    if (kept < end) hit[kept] = upsample(as_uint(dropped), NONE);
}

// One work-item per pixel: writes the weight that tau dropped, or a bound of it where not all were
// computed.
kernel void weights_dropped(
    const uint hw,                    // pixels
    global const uint *pixel_offset,  // (HW+1)
    global const ulong *hit,          // (P) weight << 32 | point
    global float *pixel_dropped)      // (HW)
{
    const uint q = get_global_id(0);
    if (q >= hw) return;
    uint i = pixel_offset[q];
    const uint end = pixel_offset[q + 1];
    while (i < end && (uint)hit[i] != NONE)
        i++;
    pixel_dropped[q] = i < end ? as_float((uint)(hit[i] >> 32)) : 0.0f;
}

// One work-item per point: reads its pairs, writes the number of those that were not dropped.
kernel void weights_kept(
    const uint n,                      // points
    global const uint *point_offset,   // (N+1)
    global const float2 *pair_weight,  // (P, 2)
    global uint *point_kept)           // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    uint kept = 0;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++)
        kept += !(signbit(pair_weight[pair].x) && signbit(pair_weight[pair].y));
    point_kept[i] = kept;
}

// One work-item per point: reads the weights of its pairs, adds their sum. Accumulates.
kernel void weights_of_points(
    const uint n,                      // points
    global const uint *point_offset,   // (N+1)
    global const float2 *pair_weight,  // (P, 2)
    global float *point_weight)        // (N) accumulates
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    float sum = 0.0f;
    for (uint pair = point_offset[i]; pair < point_offset[i + 1]; pair++)
        sum += fabs(pair_weight[pair].x);
    point_weight[i] += sum;
}
