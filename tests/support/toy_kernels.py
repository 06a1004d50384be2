"""Kernels for tests of the launcher; one writes past its buffer, some have sizes by formulas."""

SOURCE = """
# ifndef WIDTH
# define WIDTH 4
# endif

// One work-item per row: writes scale * the sum of a row of x, plus k of its row.
kernel void rows(
    const uint n,                  // rows
    const float scale,
    global const float4 *x,        // (N, WIDTH)
    global const uint *k,          // (3)
    global float *y)               // (N, 1) result
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    const float4 v = x[i];
    y[i] = scale * (v.x + v.y + v.z + v.w) + k[i % 3];
}

// One work-item: writes one float behind y.
kernel void behind(
    const uint n,                  // size of y
    global float *y)               // (N)
{
    if (get_global_id(0) == 0) y[n] = 1.0f;
}

// One work-item: nothing; its buffers' lengths are formulas.
kernel void formulas(
    const uint n,
    const int height,
    global const float *offsets,   // (N+1)
    global const float *halves,    // ((height-1)/2, WIDTH * 2)
    global const float *both,      // (a + B - 1)
    global const float *first,     // (A)
    global const float *second)    // (B)
{
}

// One work-item per element: writes whether there is no x.
kernel void is_null(
    const uint n,           // size of y
    global const float *x,  // (N) or NULL
    global uint *y)         // (N)
{
    if (get_global_id(0) < n) y[get_global_id(0)] = x == 0;
}
"""
