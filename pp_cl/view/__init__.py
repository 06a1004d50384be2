"""A run in the browser: `pp-cl view`."""
