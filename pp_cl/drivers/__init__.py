"""OpenCL drivers of this machine: which work, and which device is taken."""
