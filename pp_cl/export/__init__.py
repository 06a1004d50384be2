"""Exports a run to other programs: films, point clouds, meshes, a web page, rendered views."""
