"""The rasteriser: from points to the blended features of each pixel, and back to gradients."""
