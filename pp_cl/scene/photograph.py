"""A photograph that a scene lists, before its pixels are read."""

from dataclasses import dataclass, field

from pp_cl.scene.camera import Camera
from pp_cl.scene.distortion import Distortion


@dataclass(frozen=True)
class Photograph:
    """What a reader of a format tells of one photograph.

    name: path of the image relative to the scene's folder. camera: of the stored image, freed of
    distortion. depth_range: (near, far), Euclidean distances in world units, if the format states
    one. mask: path of its mask relative to the scene's folder, white where the object is; None: the
    image's own alpha. distortion: of the image as it lies in the file.
    """

    name: str
    camera: Camera
    depth_range: tuple[float, float] | None = None
    mask: str | None = None
    distortion: Distortion = field(default_factory=Distortion)
