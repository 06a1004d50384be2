"""Where the masks of photographs come from."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.image import read_gray


@dataclass(frozen=True)
class MaskRule:
    """How a scene's masks are made. source: given, alpha or none (settings scene.mask_from)."""

    source: str = "given"

    def apply(self, image: np.ndarray, mask: Path | None) -> np.ndarray:
        """(H, W, 4) uint8: the image with its mask as alpha.

        image: (H, W, 4) uint8. mask: the file that the format names for it, if it does. Raises
        UserError naming a mask that cannot be read or has another size.
        """
        if self.source == "none":
            return _with_alpha(image, np.uint8(255))
        if mask is None or self.source == "alpha":
            return image
        alpha = read_gray(mask)
        if alpha.shape != image.shape[:2]:
            sizes = "{1}x{0} pixels, but its image has {3}x{2}".format(*alpha.shape, *image.shape)
            raise UserError(f"{mask}: {sizes}; make it the image's size")
        return _with_alpha(image, alpha)


AS_GIVEN = MaskRule()


def _with_alpha(image, alpha):
    image = image.copy()
    image[..., 3] = alpha
    return image
