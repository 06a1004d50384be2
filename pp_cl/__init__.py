"""pp-cl: PlenopticPoints (VMV 2023) as portable OpenCL kernels with a thin Python driver."""

__version__ = "0.1.0"
