"""pp-cl: PlenopticPoints (VMV 2023) as portable OpenCL kernels with a thin Python driver."""

import importlib

__version__ = "0.1.0"

# what `from pp_cl import ...` gives, and the module that is imported for it when it is asked for
_MODULES = {
    "open_device": "pp_cl.device.discover",
    "train_scene": "pp_cl.session",
    "load": "pp_cl.run",
    "load_run": "pp_cl.run",
    "evaluate_run": "pp_cl.run",
    "Camera": "pp_cl.scene.camera",
    "Picture": "pp_cl.files.picture",
    "UserError": "pp_cl.errors",
}

__all__ = ["__version__", *_MODULES]


def __getattr__(name):
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__():
    return sorted({*globals(), *_MODULES})
