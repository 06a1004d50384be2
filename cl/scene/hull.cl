// The visual hull: which vertices of a regular grid no mask contradicts. Sets of pixels and of
// vertices are bitsets whose rows start at a new word: bit b of word w in a row is element 32 w +
// b.
#include "common.h"

#define EVEN 0x8000  // so that doubts do not borrow from the views that reject

// One work-item per word of a mask's row: reads the alpha of its 32 pixels, writes the set of those
// above `threshold`.
kernel void pack_mask(
    const uint width,  // pixels
    const uint height,
    const uint words,  // words per row
    const uint threshold,
    global const uchar *alpha,  // (height, width)
    global uint *mask)          // (W) height * words
{
    const uint word = get_global_id(0), y = get_global_id(1);
    if (word >= words || y >= height) return;
    uint columns = 0;
    for (uint x = 32 * word; x < min(width, 32 * word + 32); x++)
        columns |= (uint)(alpha[y * width + x] > threshold) << (x - 32 * word);
    mask[y * words + word] = columns;
}

// One work-item per word of a mask's row: writes the set of pixels that have one of the mask in
// their 3x3 neighbourhood. Bits beyond the row's last pixel say nothing.
kernel void widen_mask(
    const uint height,        // pixels
    const uint words,         // words per row
    const uint first,         // the written mask's first word in `masks`
    global const uint *mask,  // (W) height * words
    global uint *masks)       // (M)
{
    const uint word = get_global_id(0), y = get_global_id(1);
    if (word >= words || y >= height) return;
    uint left = 0, columns = 0, right = 0;  // of the three rows, and of the words beside
    for (uint v = max(y, 1u) - 1; v <= min(y + 1, height - 1); v++) {
        const size_t at = v * words + word;
        if (word > 0) left |= mask[at - 1];
        columns |= mask[at];
        if (word + 1 < words) right |= mask[at + 1];
    }
    masks[first + y * words + word] =
        columns | columns << 1 | columns >> 1 | left >> 31 | right << 31;
}

// One work-item per word of 32 vertices along x: projects them into the views, one view after the
// other until all are rejected too often, writes the set of those that at least `least` images see
// and that no more masks reject than `forgiven` of all views, or the same share of those that see
// it; those of the last word that are beyond the row say nothing. A vertex outside of an image is
// not seen by it. Where the mask ends within the image, the object does, and that rejects the
// vertex; where the pixel of the border that is nearest to the vertex is beside the mask, the image
// may doubt it, which counts as one image less that sees it.
kernel void carve(
    const uint ny,     // grid vertices
    const uint rows,   // grid rows: ny * nz
    const uint words,  // words per grid row
    const uint views,
    const uint least,                  // images
    const uint doubts,                 // 1: images doubt what lies beside them
    const uint forgiven,               // masks
    global const float4 *projections,  // (views, 3, 4) (i, j, k, 1) -> (u w, v w, w)
    global const uint4 *view_masks,    // (views, 4) width, height, words per row, first word
    global const uint *view_is_whole,  // (views) 1: the mask touches no border of its image
    global const uint *masks,          // (M)
    global uint *bits)                 // (rows, words)
{
    const uint word = get_global_id(0), row = get_global_id(1);
    if (word >= words || row >= rows) return;
    const float4 first = (float4)(32.0f * word, row % ny, row / ny, 1.0f);
    uint tally[32];  // below bit 16 EVEN and the views that see the vertex, above those that reject
    for (uint b = 0; b < 32; b++)
        tally[b] = EVEN;
    uint alive = 1;
    for (uint view = 0; view < views && alive; view++) {
        const float4 pu = projections[3 * view], pv = projections[3 * view + 1],
                     pw = projections[3 * view + 2];
        const float u0 = dot(pu, first), v0 = dot(pv, first), w0 = dot(pw, first);
        const uint4 mask = view_masks[view];
        const float width = mask.x, height = mask.y;
        alive = 0;
        for (uint b = 0; b < 32; b++) {
            const float w = w0 + pw.x * b;
            const float u = (u0 + pu.x * b) / w, v = (v0 + pv.x * b) / w;
            const uint in = w > 0 && u >= 0 && u < width && v >= 0 && v < height;
            const uint x = w > 0 ? clamp(u, 0.0f, width - 1) : 0;
            const uint y = w > 0 ? clamp(v, 0.0f, height - 1) : 0;
            const uint on = masks[mask.w + y * mask.z + (x >> 5)] >> (x & 31) & 1;
            const uint counts = in | view_is_whole[view];
            tally[b] += counts + ((counts & ~(in & on)) << 16);
            tally[b] -= doubts & ~counts & ~on & (w > 0);
            alive |= tally[b] >> 16 <= forgiven;
        }
    }
    uint in_hull = 0;
    for (uint b = 0; b < 32; b++) {
        const int seen = (int)(tally[b] & 0xffff) - EVEN;
        const uint rejected = tally[b] >> 16;
        in_hull |= (uint)(seen >= (int)least && views * rejected <= forgiven * seen) << b;
    }
    bits[row * words + word] = in_hull;
}
