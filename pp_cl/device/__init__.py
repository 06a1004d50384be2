"""OpenCL: choosing a device, launching kernels, allocating buffers."""
