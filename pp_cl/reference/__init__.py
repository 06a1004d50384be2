"""Float64 numpy versions of the kernels: the truth for tests, selftest and bench."""
