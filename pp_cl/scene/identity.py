"""By what a run knows its scene again, wherever it lies: the names and cameras of its training
views, and their pixels.
"""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from pp_cl.scene.photograph import Photograph
from pp_cl.scene.views import View

DIGITS = 16  # of a view's digest, hexadecimal: enough to tell pixels that were changed, not forged


def pixel_digest(image: np.ndarray) -> str:
    """Hex digest of the pixels of a uint8 image, its mask among them."""
    return hashlib.sha256(np.ascontiguousarray(image)).hexdigest()[:DIGITS]


def identity(views: Sequence[View]) -> dict[str, Any]:
    """{"scene": digest of the names and cameras, "pixels": {name: digest} of the views, None where
    the program makes them}: what the header of a checkpoint holds of its training views.
    """
    made = any(view.digest is None for view in views)
    pixels = None if made else {view.name: view.digest for view in views}
    return {"scene": fingerprint(views), "pixels": pixels}


def fingerprint(views: Sequence[View | Photograph]) -> str:
    """Hex digest of the views' names and the cameras of their files."""
    digest = hashlib.sha256()
    for view in views:
        camera = view.camera if isinstance(view, Photograph) else view.file_camera
        digest.update(f"{view.name} {camera.width}x{camera.height} ".encode())
        numbers = np.append(camera.pose.ravel(), [camera.fx, camera.fy, camera.cx, camera.cy])
        digest.update(np.round(numbers, 6).tobytes())
    return digest.hexdigest()


def difference(
    header: dict[str, Any], listed: Sequence[View | Photograph], views: Sequence[View]
) -> str:
    """How training views differ from those of a checkpoint's header, in words; "" where they are
    the same.

    listed: all of them; views: those whose pixels are compared, where the header knows any.
    """
    if fingerprint(listed) != header["scene"]:
        return "its training views have other names or cameras"
    known = header.get("pixels") or {}
    changed = [view.name for view in views if view.digest != known.get(view.name, view.digest)]
    more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
    return f"{changed[0]}{more}: other pixels, or another mask" if changed else ""
