"""The formats of an export: what each writes, under which names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pp_cl.errors import UserError
from pp_cl.export.glb import write_point_glb
from pp_cl.export.mesh import coloured_mesh, write_mesh
from pp_cl.export.page import page_text
from pp_cl.export.ply import write_ply
from pp_cl.export.points import coloured_points
from pp_cl.export.renderings import renderings
from pp_cl.files.atomic import check_file, check_new_folder, write_text
from pp_cl.run import Run
from pp_cl.scene.readers.transforms import write_scene


@dataclass(frozen=True)
class Format:
    """write(run, path, min_weight) writes it and says what it is. name: below RUN/export, where no
    path is given. suffixes: of the file; none of a folder.
    """

    write: Callable[[Run, Path, float], str]
    name: str
    suffixes: tuple[str, ...] = ()


def export(run: Run, name: str, path: Path, min_weight: float = 0.0) -> str:
    """Write a run in the format FORMATS[name]; returns what was written, in words. min_weight: of
    coloured_points, where the format is one of points.

    Raises UserError for what cannot be written, before which nothing is.
    """
    return FORMATS[name].write(run, path, min_weight)


def check_target(name: str, folder: Path, out: Path | None) -> Path:
    """Where the format FORMATS[name] of the run in `folder` is written. out: as --out says.

    Raises UserError unless it can be written there.
    """
    chosen = FORMATS[name]
    path = folder / "export" / chosen.name if out is None else out
    if chosen.suffixes and path.suffix.lower() not in chosen.suffixes:
        raise UserError(f"--out {path}: name a file that ends in {' or '.join(chosen.suffixes)}")
    check_file(path) if chosen.suffixes else check_new_folder(path)
    if out is not None and not path.parent.is_dir():
        raise UserError(f"--out {path}: {path.parent} is no folder; make it first")
    return path


def _ply(run, path, min_weight):
    points = coloured_points(run, min_weight)
    write_ply(_in_folder(path), points, run.model.cloud)
    return _count(points, run)


def _glb(run, path, min_weight):
    points = coloured_points(run, min_weight)
    write_point_glb(_in_folder(path), points)
    return _count(points, run)


def _count(points, run):
    return f"{len(points.rows)} of {run.model.cloud.count} points"


def _mesh(run, path, min_weight):
    mesh = coloured_mesh(run)
    write_mesh(_in_folder(path), mesh)
    return f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces"


def _html(run, path, min_weight):
    text = page_text(run)
    write_text(_in_folder(path), text)
    return f"{run.model.cloud.count} points, {len(text) / 1e6:.1f} MB"


def _scene(run, path, min_weight):
    splits = renderings(run)
    write_scene(splits, _in_folder(path))
    return ", ".join(f"{len(views)} {split} views" for split, views in splits.items())


def _in_folder(path):
    """The path, its folder made: RUN/export is made when there is something to write."""
    path.parent.mkdir(exist_ok=True)
    return path


FORMATS = {
    "ply": Format(_ply, "cloud.ply", (".ply",)),
    "glb": Format(_glb, "cloud.glb", (".glb",)),
    "mesh": Format(_mesh, "mesh.ply", (".ply", ".glb")),
    "html": Format(_html, "view.html", (".html",)),
    "scene": Format(_scene, "scene"),
}
