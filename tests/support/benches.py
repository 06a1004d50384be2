"""What rows of a bench hold."""

from pp_cl.reference.winograd import rounding_share

# relative L2 error of a layer with weights stored as half
HALF = {"winograd4_half": rounding_share(4)}
KEYS = {"variant", "direction", "shape", "ms", "gflops", "peak_share", "rel_l2", "max_err"}
