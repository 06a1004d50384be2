// raster/gradients.h on GPUs: a work-item has the gradients of its pixels, and work-items together sum
// what these add to the gradients of a point, in a fixed order: first 16 by 16, then these rows.
#define GROUP_ROWS (GROUP / 16)

typedef struct {
    float16 of_features[OWN_BLOCKS];  // of a work-item's pixels
    float of_alpha[OWN_BLOCKS], of_range[OWN_BLOCKS], mean[OWN_BLOCKS];
    float of_channel[OWN_BLOCKS][16];  // of the pixels of a row, one channel
} PixelGradients;

typedef struct {
    float16 f;
    float range;
    uint blocks;
    local float *weights, *sums, *rows;
} PairGradients;

#define SHARED_SUMS                                                                                \
    local float shared_weights[OWN_BLOCKS * GROUP], shared_sums[SUMS * GROUP];                     \
    local float shared_rows[GROUP_ROWS * (CHANNELS + SUMS)];
#define FEATURE_ROW(entry) FEATURES(entry)
#define PAIR_BEGIN(g, f, blocks, range)                                                            \
    (PairGradients) {                                                                              \
        f, range, blocks, shared_weights, shared_sums, shared_rows                                 \
    }

ALWAYS_INLINE float of_samples(const PairGradients *pair, const PixelGradients *g, const uint own) {
    return dot16(g->of_features[own], pair->f) + g->of_alpha[own] +
           g->of_range[own] * (pair->range - g->mean[own]);
}

ALWAYS_INLINE void
add_weights(PairGradients *pair, const PixelGradients *g, const uint own, const floats b) {
    pair->weights[GROUP * own + MEMBER] = SUM_LANES(b);
}

ALWAYS_INLINE void store_pair(
    const PairGradients *pair,
    const PixelGradients *g,
    const floats sums[SUMS],
    global float16 *features_row,
    global float *sums_row) {
    for (uint s = 0; s < SUMS; s++)
        pair->sums[GROUP * s + MEMBER] = SUM_LANES(sums[s]);
    barrier(CLK_LOCAL_MEM_FENCE);
    float of_row = 0.0f;
    UNROLLED_FOR (uint own = 0; own < OWN_BLOCKS; own++)
        for (uint i = 0; i < 16; i++) {
            const uint pixel = GROUP * own + MEMBER / 16 * 16 + i;
            if (pair->blocks >> pixel / BLOCK_PIXELS & 1)
                of_row += pair->weights[pixel] * g->of_channel[own][i];
        }
    pair->rows[MEMBER] = of_row;
    for (uint i = MEMBER; i < GROUP_ROWS * SUMS; i += GROUP) {
        float sum = 0.0f;
        for (uint item = 16 * i; item < 16 * i + 16; item++)
            sum += pair->sums[item];
        pair->rows[GROUP_ROWS * CHANNELS + i] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = MEMBER; pair->blocks && i < CHANNELS + SUMS; i += GROUP) {
        const bool is_feature = i < CHANNELS;
        const uint from = is_feature ? i : GROUP_ROWS * i, step = is_feature ? CHANNELS : 1;
        float sum = 0.0f;
        for (uint row = 0; row < GROUP_ROWS; row++)
            sum += pair->rows[from + step * row];
        if (is_feature)
            ((global float *)features_row)[i] = sum;
        else
            sums_row[i - CHANNELS] = sum;
    }
}
