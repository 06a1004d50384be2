"""Float64 twins: what benches and the selftest measure errors against, and most tests."""
