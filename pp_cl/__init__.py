"""pp-cl: PlenopticPoints (VMV 2023) as portable OpenCL kernels with a thin Python driver."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pp_cl.drivers import open_device
    from pp_cl.engine.camera import Camera
    from pp_cl.errors import UserError
    from pp_cl.evaluate import evaluate_run
    from pp_cl.files.picture import Picture
    from pp_cl.run import Run, load
    from pp_cl.scene.load import Scene, load_scene
    from pp_cl.session.training import train_scene

__version__ = "0.2.0"

__all__ = [
    "Camera",
    "Picture",
    "Run",
    "Scene",
    "UserError",
    "__version__",
    "evaluate_run",
    "load",
    "load_scene",
    "open_device",
    "train_scene",
]

# where each of them is, which is imported when it is asked for
_MODULES = {
    "Camera": "engine.camera",
    "Picture": "files.picture",
    "Run": "run",
    "Scene": "scene.load",
    "UserError": "errors",
    "evaluate_run": "evaluate",
    "load": "run",
    "load_scene": "scene.load",
    "open_device": "drivers",
    "train_scene": "session.training",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
