"""The cases of `pp-cl selftest`: every kernel against float64, numerically hard inputs included."""
