// Peak rates of a device, against which the speed of kernels is measured: multiply-adds in
// registers, and bytes copied.

// One work-item per row of out: does `rounds` times `CHAINS` multiply-adds x = x * factor + term in
// registers, and writes the sum of the chains. They begin at first, first + 1, ... so that no two
// are the same.
kernel void peak(
    const uint n,
    const int rounds,
    const float first,
    const float factor,
    const float term,
    global float16 *out)  // (n, 16)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    float16 chain[CHAINS];
#pragma unroll
    for (int c = 0; c < CHAINS; c++)
        chain[c] = first + c;
    for (int round = 0; round < rounds; round++)
#pragma unroll
        for (int c = 0; c < CHAINS; c++)
            chain[c] = chain[c] * factor + term;
    float16 sum = 0.0f;
#pragma unroll
    for (int c = 0; c < CHAINS; c++)
        sum += chain[c];
    out[i] = sum;
}

// One work-item per row of 16 floats: copies it.
kernel void peak_copy(
    const uint n,
    global const float16 *source,  // (n, 16)
    global float16 *target)        // (n, 16)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    target[i] = source[i];
}
