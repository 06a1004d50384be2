"""What writers of scene formats share: the order of views where a format knows no splits."""

from pathlib import Path

from pp_cl.engine.camera import Camera
from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.files.image import write_png
from pp_cl.scene.readers.common import HELD_OUT, hold_out


def ordered(splits: dict[str, list[View]]) -> list[View]:
    """The views of train and test in an order of which hold_out makes these splits again. Raises
    UserError where their numbers do not fit.
    """
    train, test = (list(splits.get(split, [])) for split in ("train", "test"))
    count = len(train) + len(test)
    fits = set(splits) <= {"train", "test"} and len(test) == len(hold_out(range(count), "test"))
    if not fits:
        raise UserError(
            f"the format knows no splits: every {HELD_OUT}th view is test; add --hold-out to deal"
            " the views again"
        )
    return [(test if i % HELD_OUT == 0 else train).pop(0) for i in range(count)]


def number(index: int) -> str:
    """A name that sorts as its index."""
    return f"{index:06d}"


def write_rgb(path: Path, view: View) -> None:
    """The view's colours as PNG, whatever its alpha."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, view.image[..., :3])


def write_mask(path: Path, view: View) -> None:
    """The view's alpha as a gray PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, view.image[..., 3])


def one_lens(views: list[View], name: str) -> Camera:
    """A camera whose intrinsics and size all views share. Raises UserError naming the format."""
    first = views[0].stored_camera
    keys = ("fx", "fy", "cx", "cy", "width", "height")
    if any(getattr(v.stored_camera, key) != getattr(first, key) for v in views for key in keys):
        raise UserError(f"{name} has one camera for all views, but theirs differ")
    return first
