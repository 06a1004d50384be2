// group.h on GPUs: GROUP work-items share local memory.
#ifndef PP_GPU_GROUP_H
#define PP_GPU_GROUP_H

// Before members read what others wrote to global memory.
#define GROUP_BARRIER barrier(CLK_GLOBAL_MEM_FENCE);
// Local memory of a kernel, `items` values of type T, at least as many as a work-group has items.
#define SHARED(T, name, items) local T name[items]

// Their sum, a tree: always of member i and i + GROUP / 2, then i + GROUP / 4, ..., so that its
// order is fixed.
#define GROUP_SUM(T, name)                                                                         \
    ALWAYS_INLINE T name(const T value, local T *shared) {                                         \
        const uint item = get_local_id(0), member = MEMBER;                                        \
        shared[item] = value;                                                                      \
        barrier(CLK_LOCAL_MEM_FENCE);                                                              \
        for (uint step = GROUP / 2; step > 0; step /= 2) {                                         \
            if (member < step) shared[item] += shared[item + step];                                \
            barrier(CLK_LOCAL_MEM_FENCE);                                                          \
        }                                                                                          \
        const T sum = shared[item - member];                                                       \
        barrier(CLK_LOCAL_MEM_FENCE); /* `shared` may be written again */                          \
        return sum;                                                                                \
    }
GROUP_SUM(float, group_sum)
GROUP_SUM(float4, group_sum4)

// The sum, at most the largest uint, of the values of the members before this one; of all of them
// in `total`. shared: 2 * GROUP values; a work-group has GROUP items.
ALWAYS_INLINE uint group_scan(const uint value, local uint *shared, uint *total) {
    const uint member = MEMBER;
    uint sum = value;  // of this member and the `step` - 1 before it
    uint at = 0;       // each step writes the half that the one before did not read
    for (uint step = 1; step < GROUP; step *= 2) {
        shared[at + member] = sum;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (member >= step) sum = add_sat(sum, shared[at + member - step]);
        at ^= GROUP;
    }
    local uint *sums = shared + at;
    sums[member] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    *total = sums[GROUP - 1];
    const uint before = member > 0 ? sums[member - 1] : 0;
    barrier(CLK_LOCAL_MEM_FENCE);  // `shared` may be written again
    return before;
}

#endif
