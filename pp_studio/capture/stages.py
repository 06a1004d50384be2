"""Runs the stages from photographs or a video to a scene, each of them once. A stage's result is in
SCENE/capture/STAGE.json and an image of it in STAGE.png; the same command continues after these.
"""

import shutil
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from pp_cl import open_device
from pp_cl.engine import evenly, fitting_downscale
from pp_cl.errors import UserError, few_names, pasted
from pp_cl.files import (
    atomic_folder,
    atomic_path,
    check_ours,
    contact_sheet,
    ours,
    own,
    read_rgba,
    remove_ours,
    write_json,
    write_png,
)
from pp_cl.scene import (
    HELD_OUT,
    LensDistortion,
    frame_keys,
    named_mask,
    read_edits,
    read_json,
    shrink,
)
from pp_studio.capture import STAGES, box, features, frames, masks, poses
from pp_studio.capture.overview import overview
from pp_studio.capture.packages import isolated, needed

SCENE_FILE = "transforms.json"
# Photographs of bursts, closer to each other than this share of their distance from the object, are
# held out together.
TWINS = 0.02
FOLLOWED = 4  # images that must show a point, since wrong matches seldom occur in as many
SHOWN_WIDTH = 1000  # pixels of the images of points and cameras
# decimals in the scene's file: the last digits depend on how COLMAP's threads share a sum
DECIMALS = 9
# stages that keep their unfinished work when they are stopped
RESUMED = ("features", "matches", "images", "masks")
# files and folders of each stage in the scene's folder, besides its JSON and its image
LEFT = {
    "frames": ("capture/frames",),
    "features": ("capture/inside", *(f"capture/database.db{end}" for end in ("", "-shm", "-wal"))),
    "matches": ("capture/turns",),
    "poses": ("capture/model",),
    "images": ("images",),
    "box": (),
    "masks": ("masks",),
    "scene": (SCENE_FILE, "sparse", "points.ply"),
}
CHANGING = (*LEFT["features"][1:], *LEFT["matches"])  # files that change in place
# {option: (the first stage that depends on it, its default)}
OPTIONS: dict[str, tuple[str, Any]] = {
    "source": ("frames", None),
    "turntable": ("matches", False),
    "box": ("box", None),
    "masks": ("masks", None),
    "mask_command": ("masks", None),
}


class Capture:
    """A capture in progress in the folder of a scene.

    given: {name: value} of the given OPTIONS; others are as in the captures before. tell: prints a
    stage's line. device: the choice of open_device() that removes distortion.
    """

    def __init__(
        self,
        scene: Path,
        given: dict[str, Any],
        tell: Callable[[str], None],
        device: str | None = None,
    ) -> None:
        self.scene, self.given, self.tell, self.device = scene, given, tell, device
        self.work, self.frames = scene / "capture", scene / "capture" / "frames"
        self.database, self.model = self.work / "database.db", self.work / "model"
        self.options: dict[str, Any] = {}
        self.source = Path()  # the photographs or the video

    def run(self, begin: str | None = None, *, replace_masks: bool = False) -> None:
        """Run all stages that are not done, those that depend on a changed option, and the stage
        `begin` and all after it. Masks that the user has changed are kept, or with replace_masks
        replaced. Raises UserError, before anything is removed, if a user's file would be lost, if
        a file or program that an option names is missing, and while another process captures into
        the folder.
        """
        own(self.scene, alone=True)
        self.work.mkdir(exist_ok=True)
        try:
            with FileLock(self.work / ".pp-cl.lock", timeout=0):
                self._run(begin, replace_masks)
        except Timeout:
            raise UserError(f"{self.scene}: another process captures into it; wait") from None

    def _run(self, begin, replace_masks):
        changed = self._take_options(begin)
        anew = {begin, *(OPTIONS[name][0] for name in changed)}
        anew |= {"masks"} if replace_masks else set()
        done = list(takewhile(lambda stage: stage not in anew and self._is_done(stage), STAGES))
        stages_left = list(STAGES)[len(done) :]
        mended = self._mended() if "masks" in stages_left else []
        self._check_options(stages_left, [] if replace_masks else mended)
        if mended and "images" in stages_left and not replace_masks:
            raise UserError(
                f"{mended[0]}: was made or changed by hand, for images that are made again;"
                " move it away, or add --replace-masks"
            )
        files = {stage: self._files(stage) for stage in stages_left}
        for stage in stages_left:
            check_ours(files[stage])
        for path in mended if replace_masks else ():
            path.unlink()
        for stage in reversed(stages_left):
            if stage != stages_left[0] or stage in anew or stage not in RESUMED:
                if stage == "matches" and self.database.exists():
                    features.forget_matches(self.database)
                remove_ours(files[stage])
                for name in {*CHANGING} & {*LEFT[stage]}:
                    (self.scene / name).unlink(missing_ok=True)
        if changed or not self._file("options").exists():
            write_json(self._file("options"), self.options)
        for stage in done:
            facts, came = self._found(stage), ""
            if stage == "frames":
                known = {image["source"] for image in (*facts["images"], *facts["left_out"])}
                if new := [name for name in self._names() if name not in known]:
                    came = f"; {few_names(new)} came later: --from frames takes all of them anew"
            self.tell(f"{stage}: {facts['line']} (done before{came})")
        for name in changed:
            option = "INPUT" if name == "source" else f"--{name.replace('_', '-')}"
            redone = OPTIONS[name][0]
            self.tell(f"{option} has changed: {redone} and all after it are repeated")
        made_by = {
            "frames": self._frames,
            "features": self._features,
            "matches": self._matches,
            "poses": self._poses,
            "images": self._images,
            "box": self._box,
            "masks": self._masks,
            "scene": self._scene,
        }
        for stage in stages_left:
            start = time.monotonic()
            facts = made_by[stage]()
            seconds = time.monotonic() - start
            write_json(self._file(stage), facts | {"seconds": round(seconds, 1)})
            self.tell(f"{stage}: {facts['line']} ({seconds:.0f} s)")

    def _file(self, stage, suffix=".json"):
        return self.work / f"{stage}{suffix}"

    def _found(self, stage):
        return read_json(self._file(stage))

    def _is_done(self, stage):
        return self._file(stage).is_file()

    def _names(self):
        """The names of the photographs that the source has now; [] for a video."""
        files = frames.listed(self.source) if self.source.is_dir() else []
        return [file.relative_to(self.source).as_posix() for file in files]

    def _take_options(self, begin):
        """Fill in the options of this capture; returns the names of the changed options."""
        before, is_first = {name: value for name, (_, value) in OPTIONS.items()}, True
        if self._file("options").exists():
            before, is_first = self._found("options"), False
            if not isinstance(before, dict) or before.keys() != OPTIONS.keys():
                raise UserError(
                    f"{self._file('options')}: does not have the options {', '.join(OPTIONS)};"
                    " delete it, and give them again"
                )
        self.options = before | self.given
        self.source = Path(self.options["source"])
        changed = [name for name in OPTIONS if self.options[name] != before[name] and not is_first]
        if "source" in changed and begin != "frames" and self._is_done("frames"):
            # a missing source may have moved: its photographs or video have the same names
            if self.source.is_dir():
                taken = {image["source"] for image in self._found("frames")["images"]}
                is_same = taken <= {*self._names()}
            else:
                is_same = self.source.name == Path(before["source"]).name
            if Path(before["source"]).exists() or not is_same:
                again = f"pp-cl capture {pasted(self.source)} --out {pasted(self.scene)}"
                raise UserError(
                    f"{self.scene}: was made from {before['source']}; choose another --out, or"
                    f" replace it by `{again} --from frames`"
                )
            write_json(self._file("options"), before | {"source": self.options["source"]})
            changed.remove("source")
        return changed

    def _check_options(self, stages_left, mended):
        """Raise UserError if a file or program in an option of the remaining stages is missing."""
        count, is_new = len(self._names()), "frames" in stages_left and self._is_done("frames")
        if is_new and self.source.is_dir() and count < frames.LEAST:
            raise UserError(
                f"{self.source}: {count} photographs in it, at least {frames.LEAST} are needed"
            )
        command, folder = self.options["mask_command"], self.options["masks"]
        if "masks" not in stages_left:
            return
        if command is not None and shutil.which(masks.program_words(command)[0]) is None:
            raise UserError(f"--mask-command {command}: no such program; install it, or fix it")
        if folder is not None and not Path(folder).is_dir():
            raise UserError(f"--masks {folder}: no such folder; auto makes them")
        if folder is not None and self.source.is_dir() and not {"frames", "poses"} & {*stages_left}:
            unplaced = self._found("poses")["unplaced"]
            for image in self._found("frames")["images"]:
                is_mended = masks.mask_file(self.scene, image["name"]) in mended
                if image["name"] not in unplaced and not is_mended:
                    named_mask(Path(folder), image["source"], image["name"])

    def _files(self, stage):
        """The files of a stage, without masks by others and files that change in place."""
        # its JSON is removed first: without it the stage is not done
        files = [self._file(stage), self._file(stage, ".png")]
        for path in (self.scene / name for name in LEFT[stage] if name not in CHANGING):
            inside = path.rglob("*") if path.is_dir() else [path]
            inside = [file for file in inside if file.is_symlink() or not file.is_dir()]
            files += ours(inside) if stage == "masks" else inside
        return files

    def _mended(self):
        """The images' masks that the user has made or changed, which are kept."""
        taken = self._found("frames")["images"] if self._is_done("frames") else []
        named = [masks.mask_file(self.scene, image["name"]) for image in taken]
        there = [path for path in named if path.is_file()]
        return sorted(set(there) - set(ours(there)))

    @cached_property
    def _dev(self):
        """The device that removes distortion."""
        return open_device(self.device)

    def _model(self):
        """pycolmap's model of the cameras, in its own world."""
        return needed("pycolmap").Reconstruction(self.model)

    # ---- the stages

    def _frames(self):
        facts = frames.take_images(self.source, self.frames)
        names = [image["name"] for image in evenly(facts["images"], masks.SHOWN_VIEWS)]
        whole = (read_rgba(self.frames / name) for name in names)
        shown = [
            shrink(image, fitting_downscale(image.shape[:2], masks.SHOWN_SIZE)) for image in whole
        ]
        write_png(self._file("frames", ".png"), contact_sheet(shown, names))
        left_out = [f"{image['source']} {image['reason']}" for image in facts["left_out"]]
        line = f"{len(facts['images'])} images{_but(left_out, 'left out')}"
        if _is_uniform(facts["images"]):
            line += "; the background is uniform: colour tells the object from it"
        return {"line": line, **facts}

    def _features(self):
        taken, folder = self._found("frames")["images"], self.work / "inside"
        if not (folder.is_dir() and any(folder.iterdir())):  # else it was stopped, and goes on
            names = [image["name"] for image in taken]
            masks.write_inside(self.frames, names, folder, _is_uniform(taken))
        inside = folder if folder.is_dir() and any(folder.iterdir()) else None
        counts = isolated(
            self.work, features.find_features, self.database, self.frames, taken, inside
        )
        return {"line": f"{int(np.median(list(counts.values())))} in an image", "counts": counts}

    def _matches(self):
        begun, turntable = self.work / "turns", self.options["turntable"]
        if begun.exists():  # it was stopped then, and would take matches of the object for still
            isolated(self.work, features.forget_matches, self.database)
            begun.unlink()
        pairs = isolated(self.work, features.match, self.database)
        line = f"{pairs} pairs of images"
        if _is_uniform(self._found("frames")["images"]):  # such a background has no features
            turns, line = True, f"{line}, all of the object: placed as on a turntable"
        elif turns := isolated(self.work, features.remove_still, self.database, begun, turntable):
            line += "; a turntable: the background, which stands still, is ignored"
        return {"line": line, "turns": turns}

    def _poses(self):
        taken = self._found("frames")["images"]
        turns = self._found("matches")["turns"]
        facts = isolated(
            self.work, poses.place, self.database, self.frames, self.model, taken, turns
        )
        self._show("poses", self._model(), None)
        unplaced = [f"{name} {why}" for name, why in facts["unplaced"].items()]
        line = (
            f"{facts['placed']} of {len(taken)} images, {facts['points']} points, reprojection"
            f" error {facts['error']:.2f} pixels{facts['zoomed'] and '; ' + facts['zoomed']}"
            f"{_but(unplaced, 'without a place')}"
            f"{_but(facts['weak'], 'may be a little off, by few matches')}"
        )
        return {"line": line, **facts}

    def _images(self):
        taken = poses.image_files(self._model())
        made = frames.write_images(self._dev, self.frames, self.scene / "images", taken)
        earlier = f", {len(taken) - made} of them before" if made < len(taken) else ""
        return {"line": f"{len(taken)} without distortion{earlier}"}

    def _box(self):
        model = self._model()
        cameras = [image_file.camera for image_file in poses.image_files(model)]
        world = box.find_world(cameras, poses.points(model)[0])
        given_box = self.options["box"]
        chosen = world.box if given_box is None else np.sort(np.reshape(given_box, (2, 3)), axis=0)
        if given_box is not None and read_edits(self.scene).box is not None:
            what = "the box set on its page is used in place of --box; remove it there to use --box"
            warnings.warn(f"{self.scene}: {what}", stacklevel=2)
        _move(model, world.scale, world.rotation, world.shift)
        eyes = [image_file.camera.eye for image_file in poses.image_files(model)]
        distance = np.median(np.linalg.norm(eyes, axis=1))
        self._show("box", model, chosen)
        return {
            "line": f"{_size(chosen)}, the cameras {distance:.2f} from its middle",
            "scale": float(world.scale),
            "rotation": world.rotation.tolist(),
            "shift": world.shift.tolist(),
            "box": chosen.tolist(),
        }

    def _masks(self):
        model, before = self._world()
        corners, edits = before, read_edits(self.scene)
        taken = {image_file.name: image_file for image_file in poses.image_files(model)}
        image_files = [replace(image_file, lens=LensDistortion()) for image_file in taken.values()]
        points, seen_points = poses.points(model, FOLLOWED)
        files = self._found("frames")["images"] if self.source.is_dir() else []

        def keep(larger):  # the masks that are kept may be all, when this is resumed
            write_json(self._file("box"), self._found("box") | {"box": larger.tolist()})

        def write(chosen):
            return masks.write_masks(
                self.scene,
                [image_files[i] for i in chosen],
                corners,
                points,
                [seen_points[i] for i in chosen],
                given=self.options["masks"] and Path(self.options["masks"]),
                sources={image["name"]: image["source"] for image in files},
                fitted=lambda name, mask: frames.undistorted_mask(self._dev, mask, taken[name]),
                command=self.options["mask_command"],
                turns=self._found("matches")["turns"],
                grows=self.options["box"] is None and edits.box is None,
                grown=keep,
            )

        used = [
            i for i, image_file in enumerate(image_files) if image_file.name not in edits.dropped
        ]
        line, wrong, corners = write(used)
        if edits.dropped:  # dropped images have no vote in the masks of the others
            write(range(len(image_files)))
        sheet = masks.outline_sheet(self.scene, image_files, wrong)
        write_png(self._file("masks", ".png"), sheet)
        if (corners == before).all():
            return {"line": line}
        return {
            "line": f"{line}; the box cut the object: now {_size(corners)}",
            "box": corners.tolist(),
        }

    def _scene(self):
        model, corners = self._world()
        image_files = poses.image_files(model)
        places = []
        for image_file in image_files:
            mask = masks.mask_file(Path(), image_file.name).as_posix()
            keys = {key: _rounded(value) for key, value in frame_keys(image_file.camera).items()}
            places.append({"file_path": image_file.name, "mask_path": mask, **keys})
        poses.undistort_model(model)
        with atomic_folder(self.scene / "sparse") as unfinished:
            (unfinished / "0").mkdir()
            model.write(unfinished / "0")
        with atomic_path(self.scene / "points.ply") as unfinished:
            model.export_PLY(unfinished)
        stated = {"camera_model": "OPENCV", "ply_file_path": "points.ply"}
        of_splits, twins = _splits(image_files)
        stated |= {"aabb": _rounded(corners), **of_splits, "frames": places}
        write_json(self.scene / SCENE_FILE, stated)
        line = f"wrote {self.scene / SCENE_FILE} with {len(image_files)} photographs"
        if twins:
            line += f", {twins} of them from the place of another, so held out with it or not"
        return {"line": line}

    def _show(self, stage, model, corners):
        """Write a stage's image, which shows a model's points and cameras, and a box (2, 3)."""
        cameras = [image_file.camera for image_file in poses.image_files(model)]
        colours = np.array([point.color for point in model.points3D.values()])
        drawn = overview(cameras, corners, poses.points(model)[0], colours, SHOWN_WIDTH)
        write_png(self._file(stage, ".png"), drawn)

    def _world(self):
        """(pycolmap's model in the scene's world, (2, 3) box from the user, the masks or the
        stage).
        """
        model, facts = self._model(), self._found("box")
        _move(model, facts["scale"], np.array(facts["rotation"]), np.array(facts["shift"]))
        edited = read_edits(self.scene).box
        if edited is not None:
            return model, edited
        grown = self._found("masks").get("box") if self._is_done("masks") else None
        return model, np.array(grown or facts["box"])


def _splits(image_files):
    """({the lists of the scene's splits}, how many photographs are from the place of another, as in
    bursts): every eighth place is for test. No lists without such photographs, as readers do so.
    """
    eyes = np.array([image_file.camera.eye for image_file in image_files])
    reach = TWINS * np.median(np.linalg.norm(eyes, axis=1))
    places: list[list[int]] = []
    for i, eye in enumerate(eyes):
        away = [np.linalg.norm(eyes[place[0]] - eye) for place in places]
        if away and min(away) < reach:
            places[int(np.argmin(away))].append(i)
        else:
            places.append([i])
    if len(places) == len(eyes):
        return {}, 0
    held = {i for place in places[::HELD_OUT] for i in place}
    lists: dict[str, list[str]] = {"train_filenames": [], "test_filenames": []}
    for i, image_file in enumerate(image_files):
        lists["test_filenames" if i in held else "train_filenames"].append(image_file.name)
    return lists, len(eyes) - len(places)


def _is_uniform(taken):
    """Whether nearly all images have a uniform background, according to take_images()."""
    return float(np.mean([image.get("uniform", False) for image in taken])) >= masks.UNIFORM


def _size(corners):
    return " x ".join(f"{side:.2f}" for side in np.ptp(corners, axis=0))


def _rounded(values):
    return np.round(values, DECIMALS).tolist()


def _move(model, scale, rotation, shift):
    """Move pycolmap's model by a similarity."""
    colmap = needed("pycolmap")
    model.transform(colmap.Sim3d(scale, colmap.Rotation3d(rotation), shift))


def _but(lines: Sequence[str], what: str) -> str:
    """Text such as `; 3 left out: A, B and 1 more`, empty without lines."""
    return f"; {len(lines)} {what}: {few_names(lines)}" if lines else ""
