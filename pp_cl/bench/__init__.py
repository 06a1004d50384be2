"""Timing of kernels, layers, the network and the rasteriser, with their errors."""
