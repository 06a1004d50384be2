// raster/tiles.h on GPUs: GROUP work-items walk for a tile, each with one pixel of OWN_BLOCKS of its
// blocks, whose samples are in the lanes of its vectors.
#define OWN_BLOCKS (TILE_SAMPLES / SAMPLES / GROUP)
#define BLOCK(own) ((own) * (GROUP / BLOCK_PIXELS) + MEMBER / BLOCK_PIXELS)
#define FOR_BLOCKS(own, bits)                                                                      \
    UNROLLED_FOR (uint own = 0; own < OWN_BLOCKS; own++)                                           \
        if ((bits) >> BLOCK(own) & 1)

#define SAMPLE (BLOCK_PIXELS * LANE + MEMBER % BLOCK_PIXELS)
#define SAMPLE_VALUES(type, array, row)                                                            \
    ((global type *)(array))[(row) * BLOCK_PIXELS + MEMBER % BLOCK_PIXELS]

#define FOR_PIXELS(k) for (int k = MEMBER % BLOCK_PIXELS, once = 1; once; once = 0)
#define OF_PIXEL(k) 0
#define OWN_PIXELS 1

// A work-group reads BATCH_PAIRS entries of a list, with their points, into local memory. `entry`
// names the entry of the step `first` + k.
#define BATCH_PAIRS 32
#define BATCH(left) min((uint)BATCH_PAIRS, left)
#define SHARED_LIST                                                                                \
    local ulong shared_entry[BATCH_PAIRS];                                                         \
    local uint shared_record[RECORD * BATCH_PAIRS];                                                \
    local uint shared_vote[1];
#define READ_BATCH(entry)                                                                          \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                  \
    for (uint k = MEMBER; k < batch; k += GROUP)                                                   \
        shared_entry[k] = entry;                                                                   \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                  \
    for (uint i = MEMBER; i < RECORD * batch; i += GROUP)                                          \
        shared_record[i] =                                                                         \
            point_record[RECORD * (size_t)(uint)shared_entry[i / RECORD] + i % RECORD];            \
    barrier(CLK_LOCAL_MEM_FENCE);
#define ENTRY(entry) shared_entry[k]
#define POINT(entry) POINT_OF(shared_record, k)
#define SHARED_FEATURES local float shared_features[CHANNELS * BATCH_PAIRS];
#define READ_FEATURES                                                                              \
    for (uint i = MEMBER; i < CHANNELS * batch; i += GROUP) {                                      \
        const ulong entry = shared_entry[i / CHANNELS];                                            \
        /* the point of an entry without a block may have no row */                                \
        const size_t row = entry >> 32 ? point_slot[(uint)entry] : 0;                              \
        shared_features[i] =                                                                       \
            ((global const float *)visible_features)[CHANNELS * row + i % CHANNELS];               \
    }                                                                                              \
    barrier(CLK_LOCAL_MEM_FENCE);
#define FEATURES(entry) vload16(k, shared_features)

// All work-items of a group ask together.
#define ANY_MEMBER(value) any_member(value, shared_vote)
ALWAYS_INLINE bool any_member(const uint value, local uint *vote) {
    barrier(CLK_LOCAL_MEM_FENCE);
    if (MEMBER == 0) *vote = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (value) *vote = 1;  // all write the same
    barrier(CLK_LOCAL_MEM_FENCE);
    return *vote;
}
#define IS_DONE(live) false
#define any_sample(v) ANY_LANE(v)

#define sum_pixels(v, sums) ((sums)[0] = SUM_LANES(v))
#define add_features(sums, b, f) ((sums)[0] += SUM_LANES(b) * (f))

ALWAYS_INLINE floats least_of_pixels(const floats v) {
#if SAMPLES == 4
    return (floats)(fmin(fmin(v.x, v.y), fmin(v.z, v.w)));
#else
    return v;
#endif
}
