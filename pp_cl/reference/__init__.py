"""Float64 twins that benches measure errors against."""
