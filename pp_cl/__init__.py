"""pp-cl: PlenopticPoints (VMV 2023) as portable OpenCL kernels with a thin Python driver.

docs/api.md lists what it offers to other programs: the names here and in pp_cl.engine, files,
scene, config, errors and commands. Those of __init__.pyi are imported when they are asked for.
"""

import lazy_loader

__version__ = "0.4.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
