"""What a run becomes in other programs: point clouds, meshes, a web page, renderings."""
