"""The libraries that exports need and nothing else does."""

import importlib
from types import ModuleType

from pp_cl.errors import UserError


def library(name: str) -> ModuleType:
    """The module. Raises UserError naming the extra to install where there is none."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError(
            f"this format is written with {name}, which is missing: pip install pp-cl[export]"
        ) from None
