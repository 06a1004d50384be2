// Gathering rows of an array by index: to compact it after pruning, or to repeat rows for refining.
#include "group.h"

// GROUP work-items per row of the result: copy it from its old place.
kernel void gather_rows(
    const uint first,            // of the listed rows that are copied: its place in the list
    const uint m,                // rows to copy
    const uint r,                // words in a row
    global const uint *indices,  // (?) old places of all listed rows
    global const uint *source,   // (?, R)
    global uint *target)         // (?, R) at least M rows
{
    const size_t i = get_global_id(0) / GROUP;
    if (i >= m) return;
    global const uint *from = source + (size_t)indices[first + i] * r;
    global uint *to = target + i * r;
    for (uint c = MEMBER; c < r; c += GROUP)
        to[c] = from[c];
}
