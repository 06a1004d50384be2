"""What is made of photographs and runs: scenes, videos, pages, splats, meshes, a viewer, sweeps."""

from pp_studio.export.formats import export as export_run

__all__ = ["export_run"]
