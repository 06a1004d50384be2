"""Benchmarks of kernels, layers, network, rasteriser and training, with their errors."""
