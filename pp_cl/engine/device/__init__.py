"""The layer over OpenCL: devices, kernel launches, buffers, transfers, prefix sums."""
