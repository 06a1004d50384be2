"""Makes scenes of photographs, makes videos, pages, splats and meshes of runs, views and sweeps."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
