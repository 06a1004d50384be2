"""The numerical hard cases and comparisons with float64 that `pp-cl selftest` runs."""
