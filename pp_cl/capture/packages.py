"""The packages of the extra `capture`, which are imported where they are needed."""

import importlib
from types import ModuleType

from PIL import Image  # noqa: F401  before pycolmap, whose zlib would otherwise be taken for Pillow's

from pp_cl.errors import UserError

DISTRIBUTIONS = {
    "pycolmap": "pycolmap",
    "cv2": "opencv-python-headless",
    "pillow_heif": "pillow-heif",
    "imageio_ffmpeg": "imageio-ffmpeg",
}


def needed(module: str) -> ModuleType:
    """The imported module. Raises UserError with the command that installs it where it is
    missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UserError(
            f"capture needs the package {DISTRIBUTIONS[module]} ({error}):"
            " pip install pp-cl[capture]"
        ) from None
