"""Reader of scenes in the format of NSVF and Plenoxels (svox2): rgb/ or images/, whose image names
begin with the split, pose/, one intrinsics.txt, and maybe near_and_far.txt.
"""

from pathlib import Path

from pp_cl.engine.camera import Camera
from pp_cl.errors import Unusable, UserError
from pp_cl.files.image import image_size
from pp_cl.scene.image_file import ImageFile
from pp_cl.scene.lookup import LeftOut, find_file, folder_images, image_folder, usable
from pp_cl.scene.readers.common import fail_at, fitted, read_numbers
from pp_cl.scene.readers.frame import rigid

FILES = "rgb, pose and intrinsics.txt (NSVF)"
STATES = "camera-to-world", "opencv"
PREFIXES = {"0_": "train", "1_": "val", "2_": "test"}
IMAGES, POSES, INTRINSICS = ("rgb", "images", "image"), "pose", "intrinsics.txt"


def recognises(folder: Path) -> bool:
    """Whether the folder has both subfolders and the intrinsics."""
    folders = (folder / image_folder(folder, IMAGES)).is_dir() and (folder / POSES).is_dir()
    return folders and (folder / INTRINSICS).is_file()


def splits(folder: Path) -> list[str]:
    """The splits whose prefix some image's name has: 0_ train, 1_ val, 2_ test; without 2_, as in
    NSVF's Tanks and Temples and BlendedMVS, 1_ is test.
    """
    return sorted(_names(folder))


def read_split(folder: Path, split: str, left_out: LeftOut) -> list[ImageFile]:
    """The images of a split, in the order of their names. Poses are camera-to-world with
    OpenCV's axes; near and far are Euclidean distances. Raises UserError naming the file.
    """
    names = _names(folder)[split]
    file, file_of_range = folder / INTRINSICS, folder / "near_and_far.txt"
    lens, stated = _lens(file)
    depth_range = None
    if file_of_range.is_file():
        values = [value for row in read_numbers(file_of_range) for value in row]
        if len(values) != 2 or not 0 < values[0] < values[1]:
            raise UserError(f"{file_of_range}: must be two numbers, 0 < near < far")
        depth_range = values[0], values[1]

    def read(name):
        pose_file = find_file(folder / POSES, f"{Path(name).stem}.txt")
        if not pose_file.exists():
            raise Unusable(f"{pose_file}: no such file; copy it there", "no pose")
        pose = rigid(read_numbers(pose_file), fail_at(pose_file))
        size = image_size(folder / name, stated)
        camera = Camera(pose, *lens, *(stated or size))
        return ImageFile(name, fitted(camera, size, fail_at(file)), depth_range)

    return list(usable(names, read, str, left_out))


def _names(folder):
    """{split: names of its images}. Raises UserError if no name has a prefix."""
    names, place = {}, image_folder(folder, IMAGES)
    for name in folder_images(folder, place):
        if split := PREFIXES.get(Path(name).name[:2]):
            names.setdefault(split, []).append(name)
    if not names:
        raise UserError(
            f"{folder / place}: no image belongs to a split; begin the names with 0_ (train),"
            " 1_ (val) or 2_ (test)"
        )
    if "test" not in names and "val" in names:
        names["test"] = names.pop("val")
    return names


def _lens(file):
    """((fx, fy, cx, cy), the (width, height) they are for, or None) from a file with a 4x4 or 3x3
    matrix, or with `focal cx cy 0` first and maybe the height and width last.
    """
    rows, fail = read_numbers(file), fail_at(file)
    lengths, size = [len(row) for row in rows], None
    if lengths in ([4] * 4, [3] * 3):
        (fx, skew, cx, *_), (_, fy, cy, *_) = rows[:2]
        if abs(skew) > 1e-6 * abs(fx):
            raise fail(f"has a skew of {skew:.3g} pixels, which is not modelled")
    elif rows and lengths[0] in (3, 4):
        fx, cx, cy = rows[0][:3]
        fy = fx
        size = (rows[-1][1], rows[-1][0]) if len(rows) > 1 and lengths[-1] == 2 else None
    else:
        raise fail("must be a 4x4 matrix, or begin with focal length, cx and cy")
    if not min(fx, fy) > 0:
        raise fail(f"the focal length is {min(fx, fy):g}; must be above 0")
    if size is not None and not min(size) > 0:
        raise fail("the last line must be the height and the width of the images")
    return (fx, fy, cx, cy), size
