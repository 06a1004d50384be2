// Compaction of per-point arrays.

// One work-item per kept row: copies it from its old place.
kernel void gather_rows(
    const uint m,                         // kept rows
    const uint r,                         // words in a row
    global const uint *indices,           // (M) old places
    global const uint *source,            // (N, R)
    global uint *target)                  // (M, R)
{
    const size_t i = get_global_id(0);
    if (i >= m)
        return;
    global const uint *from = source + (size_t)indices[i] * r;
    global uint *to = target + i * r;
    for (uint c = 0; c < r; c++)
        to[c] = from[c];
}
