"""One module a scene format."""
