// What a pair of a point and a pixel may do, where not all pairs do the same.
#ifndef PP_PAIR_ROLE_H
#define PP_PAIR_ROLE_H

#define TRACKED 0    // contributes to the image and gets a gradient
#define UNTRACKED 1  // contributes to the image only
#define DROPPED 2    // contributes to nothing

#ifndef HAS_ROLES
#define HAS_ROLES 1  // 0: every pair is tracked, and pair_role is neither read nor written
#endif

#endif
