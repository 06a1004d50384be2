"""What rows of a bench hold."""

KEYS = {"variant", "direction", "shape", "ms", "gflops", "peak_share", "rel_l2", "max_err"}
