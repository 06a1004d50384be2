// What is known of the colours of each view: (VIEWS, ROWS, 4) floats, sums of products of the two
// halves of its images, then its matrix.
#ifndef PP_EXPOSURE_H
#define PP_EXPOSURE_H

// rows of one half: products of rendering and rendering, 4; of image and rendering, 3; squares of
// the image
#define SUMS 8
#define MATRIX (2 * SUMS)  // first row of a view's matrix
#define ROWS (MATRIX + 3)

#endif
