"""Float64 numpy versions of the kernels, with which tests, selftest and bench compare them."""
