"""The folder that keeps what is fetched or measured once: PP_CACHE, else `pp-cl` in the user's
cache.
"""

import os
from pathlib import Path

from platformdirs import user_cache_dir

from pp_cl.errors import UserError


def cache_folder() -> Path:
    """PP_CACHE, else the user's cache folder of the system."""
    return Path(os.environ.get("PP_CACHE") or user_cache_dir("pp-cl"))


def make_cache_folder() -> Path:
    """The same, made where it is missing. Raises UserError if that fails."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be made ({error.strerror}); "
            "set PP_CACHE to a folder that can be written"
        ) from None
    return folder
