"""Reads and writes files: checkpoints, images, videos, the folder of a run; written atomically and
checked when read.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
