"""The formats of `pp-cl export`: which files each one writes."""

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

from pp_cl import Run
from pp_cl.engine import View
from pp_cl.errors import UserError, require
from pp_cl.files import check_file, check_new_folder, check_ours, image_paths, own, write_text
from pp_cl.scene import write_scene
from pp_studio.export import (
    AXES_OF,
    FORMATS,
    QUICK,
    SPLATS,
    VIEWER,
    gaussians,
    gltf,
    length,
    mesh,
    page,
    points,
    splat,
    texture,
)


def check_target(name: str, folder: Path, out: Path | None) -> Path:
    """The path to which the format FORMATS[name] of the run in `folder` is written. out: from
    --out. Raises UserError unless it can be written without losing a file that `out` does not name.
    """
    default, suffixes, _ = FORMATS[name]
    path = folder / "export" / default if out is None else out
    if suffixes and path.suffix.lower() not in suffixes:
        raise UserError(f"--out {path}: name a file that ends in {' or '.join(suffixes)}")
    check_file(path) if suffixes else check_new_folder(path)
    if out is None and suffixes:
        check_ours([path], "move it away, or choose another --out")
    if name == "textured" and path.suffix.lower() == ".obj" and not texture.is_textured(path):
        check_ours(texture.companions(path), "move it away, or choose another --out")
    if out is not None and not path.parent.is_dir():
        raise UserError(f"--out {path}: {path.parent} is no folder; make it first")
    return path


def export_run(
    run: Run,
    name: str,
    path: Path | str,
    *,
    min_weight: float = 0.0,
    quality: str | None = QUICK,
    box: Sequence[float] | None = None,
    axes: str | None = None,
    others: Iterable[Run] = (),
) -> str:
    """Write a run in the format `name` of `pp-cl export`; returns in words what was written.
    min_weight, quality, box, axes: as the options. others: further runs of a gallery. Raises
    UserError, before anything is written, if the run cannot be exported.
    """
    if name not in FORMATS:
        raise UserError(f"no format {name}; choose from {', '.join(FORMATS)}")
    path, count, metres = Path(path), run.model.cloud.count, length.metres_per_unit(run)
    unit, is_stl = "" if metres == 1 else ", in metres", path.suffix.lower() == ".stl"
    if name == "mesh" and is_stl and metres != 1:  # which slicers take for millimetres
        metres, unit = 1000 * metres, ", in millimetres"
    within, turn = None, np.eye(3)
    if box is not None:
        within = np.sort(np.reshape(box, (2, 3)), axis=0)
        points.inside(run.model.positions(), within)  # an empty box is refused before any work
    if (axes or AXES_OF.get(name)) == VIEWER:
        turn = splat.upright(run, splat.Y_DOWN if name == "splat" else splat.Y_UP)

    def placed(positions):
        return metres * points.in_world(positions @ turn.T, run.model.grid.voxel_size)

    if name == "gallery":
        return f"{page.write_gallery(path, chain([run], others))} pages and their index"
    if name == "scene":
        splits = renderings(run)
        write_scene(splits, path)
        return ", ".join(f"{len(views)} {split} views" for split, views in splits.items())
    write: Callable[[], None]
    if name == "mesh":
        made = mesh.coloured_mesh(run, within)
        vertices, origin = placed(made.vertices), np.zeros(3)
        if is_stl and vertices.dtype == np.float64:  # STL holds float32
            origin = np.rint(vertices.mean(0))
        write = partial(mesh.write_mesh, path, replace(made, vertices=vertices - origin))
        unlit = ", unlit" if path.suffix.lower() == ".glb" else ""
        words = f"{len(vertices)} vertices, {_faces(len(made.faces), made.seen)}{unlit}{unit}"
        words += _less(origin)
    elif name == "textured":
        solid = texture.textured_mesh(run, turn, within)
        solid.apply_scale(metres)
        write = partial(texture.write_textured, path, solid)
        faces = _faces(len(solid.faces), solid.metadata[mesh.SEEN_FACES])
        unlit = ", unlit" if path.suffix.lower() == ".glb" else ", with its .mtl and .png"
        words = f"{len(solid.vertices)} vertices, {faces}{unlit}{unit}"
    elif name == "html":
        fitted = gaussians.fitted_gaussians(run)
        text = page.page_text(fitted, run.cameras("train"), run.folder.name)
        write = partial(write_text, path, text)
        words = f"{len(fitted.table)} Gaussians, {len(text) / 1e6:.1f} MB"
    elif name in SPLATS:
        if name == "splat-spz":
            require("splat-spz", "gsply")
        table, origin = splat.splats(run, turn, quality, within)
        for field in ("position", "deviations"):
            table[field] *= metres
        if name == "splat-spz":
            table, times = splat.in_spz(table)
            unit += "" if times == 1 else f", times {times:g}"
            unit += splat.cut_in_spz(table)
        words = f"{len(table)} Gaussians{unit}"
        if name == "splat-glb":
            write = partial(splat.write_splat_glb, path, table, metres * origin)
        else:
            kind = splat.write_splat_ply if name == "splat" else splat.write_splat_spz
            write = partial(kind, path, table)
            words += _less(metres * origin)
    else:
        kept = points.coloured_points(run, min_weight, within)
        radius = np.float32(metres) * kept.radius
        kept = replace(kept, positions=placed(kept.positions), radius=radius)
        words = f"{len(kept.rows)} of {count} points{unit}"
        if name == "ply":
            axes = "turned upright, y up" if axes == VIEWER else "its scene's"
            write = partial(points.write_ply, path, kept, run.model.cloud, f"{axes}{unit}")
        else:
            colours = gltf.gltf_colours(kept.colours / 255)
            write = partial(gltf.write_glb, path, {"POSITION": kept.positions, "COLOR_0": colours})
    if path.parts[-2:] == ("export", FORMATS[name][0]):  # the default folder, without --out
        own(path.parent)
    write()
    return words


def _less(origin):
    """What is subtracted from positions, in words; "" for 0."""
    return f", less {', '.join(f'{x:.9g}' for x in origin)}" if origin.any() else ""


def _faces(count, shown):
    """The number of faces, and how many of them are guessed, in words."""
    guessed = f" ({count - shown} of them guessed)" if shown < count else ""
    return f"{count} faces{guessed}"


def renderings(run: Run) -> dict[str, list[View]]:
    """{split: views} of train and test at the run's resolution; each image is the run's rendering,
    in straight RGBA. If the scene has no readable test views, they are left out with a warning that
    says why.
    """
    splits = {"train": run.image_files("train")}
    try:
        splits["test"] = run.image_files("test")
    except UserError as error:
        warnings.warn(f"no test views are exported: {error}", stacklevel=2)
    rendered = {}
    for split, listed in splits.items():
        files, views = (
            image_paths([file.name for file in listed]),
            run.rendered(listed, opaque=False),
        )
        named = zip(views, files, strict=True)
        rendered[split] = [replace(view, name=f"{split}/{file}") for view, file in named]
    return rendered
