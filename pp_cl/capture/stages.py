"""The stages from photographs or a film to a scene, each of which is done once: what it found lies
in SCENE/capture/STAGE.json, a picture of it in STAGE.png; the same command goes on after these.
"""

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from pp_cl.capture import STAGES, box, features, frames, masks, poses, still
from pp_cl.capture.packages import isolated, needed
from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_folder, atomic_path, remove_leftovers, write_json
from pp_cl.files.contact_sheet import contact_sheet
from pp_cl.files.image import read_rgba, write_png
from pp_cl.scene.agreement import listing
from pp_cl.scene.edits import read_edits
from pp_cl.scene.outline import SHOWN_SIZE, SHOWN_VIEWS
from pp_cl.scene.overview import overview
from pp_cl.scene.readers.common import read_json
from pp_cl.scene.readers.frame import frame_keys
from pp_cl.scene.readers.transforms import SINGLE
from pp_cl.scene.views import evenly, fitting_downscale, shrink

FOLLOWED = 4  # images that show a point: wrong matches are seldom found again in so many
SHOWN_WIDTH = 1000  # pixels of the pictures of points and cameras
RESUMED = ("features", "matches", "masks")  # stages that keep what was done when they are stopped
# what each stage leaves beside its JSON, in the scene's folder
LEFT = {
    "frames": ("images",),
    "features": (
        "capture/inside",
        "capture/database.db",
        "capture/database.db-shm",
        "capture/database.db-wal",
    ),
    "matches": ("capture/turns",),
    "poses": ("capture/model",),
    "box": (),
    "masks": ("masks",),
    "scene": (SINGLE, "sparse", "points.ply"),
}


class Capture:
    """A capture in progress: what it is made from, and the folder of its scene.

    given: the options that a stage depends on. tell: prints a line of a stage.
    """

    def __init__(self, source: Path, scene: Path, given: dict, tell: Callable[[str], None]) -> None:
        self.source, self.scene, self.given, self.tell = source, scene, given, tell
        self.work, self.images = scene / "capture", scene / "images"
        self.database, self.model = self.work / "database.db", self.work / "model"
        self.turns = self.work / "turns"

    def run(self, begin: str | None = None) -> None:
        """Do all stages that are not done, or one of them and all after it. Raises UserError."""
        with self._locked():
            remove_leftovers(self.scene)
            first, stages = self._first(begin), list(STAGES)
            for stage in reversed(stages[first:]):
                if stage not in RESUMED or stage != stages[first] or self._file(stage).is_file():
                    self._undo(stage)
            for stage in stages[:first]:
                new = self._new() if stage == "frames" else ""
                self.tell(f"{stage}: {self._found(stage)['line']} (done before{new})")
            for stage in stages[first:]:
                start = time.monotonic()
                found = getattr(self, f"_{stage}")()
                write_json(self._file(stage), {"given": self._given(stage), "found": found})
                self.tell(f"{stage}: {found['line']} ({time.monotonic() - start:.0f} s)")

    def _new(self):
        """What photographs have come since they were taken, in words."""
        found = self._found("frames")
        known = {one["source"] for one in (*found["images"], *found["left_out"])}
        files = frames.listed(self.source) if self.source.is_dir() else []
        new = [file.name for file in files if file.name not in known]
        return f"; {listing(new)} came later: --from frames takes all anew" if new else ""

    @contextmanager
    def _locked(self):
        """While it is entered, no other process captures into the folder, which is made."""
        if self.scene.exists() and not self.work.exists() and any(self.scene.iterdir()):
            raise UserError(f"{self.scene}: exists already; choose a new or empty folder")
        try:
            self.work.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.work / ".lock", timeout=0)
            with lock:
                yield
        except Timeout:
            raise UserError(f"{self.scene}: another process captures into it; wait") from None

    def _given(self, stage):
        """The options on which a stage's result depends."""
        given = {"frames": {"source": str(self.source.resolve())}}
        return given.get(stage) or self.given.get(stage, {})

    def _first(self, begin):
        """The number of the first stage to be done."""
        for number, stage in enumerate(STAGES):
            if stage == begin or not self._file(stage).is_file():
                return number
            before = read_json(self._file(stage))["given"]
            if before != self._given(stage):
                if stage == "frames":
                    raise UserError(
                        f"{self.scene}: was made from {before['source']}; choose another --out, or"
                        " begin anew with --from frames"
                    )
                return number
        return len(STAGES)

    def _undo(self, stage):
        """Remove what a stage has left."""
        self._file(stage).unlink(missing_ok=True)
        self._file(stage).with_suffix(".png").unlink(missing_ok=True)
        if stage == "matches" and self.database.exists():
            features.forget_matches(self.database)
        for name in LEFT[stage]:
            path = self.scene / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def _show(self, stage, picture):
        write_png(self._file(stage).with_suffix(".png"), picture)

    def _found(self, stage):
        return read_json(self._file(stage))["found"]

    def _file(self, stage):
        return self.work / f"{stage}.json"

    # ---- the stages

    def _frames(self):
        found = frames.take_images(self.source, self.images)
        names = [one["name"] for one in evenly(found["images"], SHOWN_VIEWS)]
        shown = [read_rgba(self.images / name) for name in names]
        shown = [shrink(one, fitting_downscale(one.shape[:2], SHOWN_SIZE)) for one in shown]
        self._show("frames", contact_sheet(shown, names))
        left_out = [f"{one['source']} {one['reason']}" for one in found["left_out"]]
        line = f"{len(found['images'])} images" + _left_out(left_out, "left out")
        return {"line": line, **found}

    def _features(self):
        taken = self._found("frames")["images"]
        inside = None
        if self.given["features"]["turntable"]:
            inside = self._inside([one["name"] for one in taken])
        counts = isolated(
            self.work, features.find_features, self.database, self.images, taken, inside
        )
        middle = int(np.median(list(counts.values())))
        return {"line": f"{middle} in an image", "counts": counts}

    def _inside(self, names):
        """A folder of masks by the uniform background, in which features are looked for; None where
        the background is not uniform, but stands still.
        """
        folder = self.work / "inside"
        try:
            with atomic_folder(folder) as unfinished:
                for name in names:
                    mask = masks.uniform_mask(read_rgba(self.images / name), name)
                    if mask is None:
                        raise UserError(name)
                    write_png(unfinished / f"{name}.png", mask)
        except UserError:
            return None
        return folder

    def _matches(self):
        is_film = not self.source.is_dir()
        pairs = isolated(self.work, features.match, self.database, is_film)
        turntable = self.given["features"]["turntable"]
        turns = isolated(self.work, still.remove_still, self.database, self.turns, turntable)
        line = f"{pairs} pairs of images"
        if turns:
            line += "; the object turns before a background that stands still, which is left out"
        return {"line": line, "turns": turns}

    def _poses(self):
        taken = self._found("frames")["images"]
        turns = self._found("matches")["turns"]
        found = isolated(
            self.work, poses.place, self.database, self.images, self.model, taken, turns
        )
        model = needed("pycolmap").Reconstruction(self.model)
        self._show("poses", _seen_from_outside(model, None))
        unplaced = [f"{name} {why}" for name, why in found["unplaced"].items()]
        line = (
            f"{found['placed']} of {len(taken)} images, {found['points']} points, reprojection"
            f" error {found['error']:.2f} pixels"
        )
        return {"line": line + _left_out(unplaced, "without a place"), **found}

    def _box(self):
        model = needed("pycolmap").Reconstruction(self.model)
        cameras = [one.camera for one in poses.photographs(model, "images")]
        world = box.find_world(cameras, poses.points(model)[0])
        corners = self.given["box"]["box"]
        chosen = world.box if corners is None else np.sort(np.reshape(corners, (2, 3)), axis=0)
        size = " x ".join(f"{side:.2f}" for side in np.ptp(chosen, axis=0))
        _move(model, world.scale, world.rotation, world.shift)
        self._show("box", _seen_from_outside(model, chosen))
        return {
            "line": f"{size}, the cameras {_distance(cameras, world):.2f} from its middle",
            "scale": float(world.scale),
            "rotation": world.rotation.tolist(),
            "shift": world.shift.tolist(),
            "box": chosen.tolist(),
        }

    def _masks(self):
        model, corners = self._world()
        given, dropped = self.given["masks"], read_edits(self.scene).dropped
        photographs, folder = poses.photographs(model, "images"), self.scene / "masks"
        points, seen = poses.points(model, FOLLOWED)
        kept = [i for i, one in enumerate(photographs) if one.name not in dropped]
        taken = self._found("frames")["images"] if self.source.is_dir() else []
        sources = {one["name"]: one["source"] for one in taken}

        def write(chosen):
            return masks.write_masks(
                self.scene,
                folder,
                [photographs[i] for i in chosen],
                corners,
                points,
                [seen[i] for i in chosen],
                given=given["masks"] and Path(given["masks"]),
                sources=sources,
                command=given["command"],
                turns=self._found("matches")["turns"],
            )

        line, wrong = write(kept)
        if dropped:  # they have had no say in the others
            write(range(len(photographs)))
        self._show("masks", masks.picture(self.scene, folder, photographs, wrong))
        return {"line": line}

    def _scene(self):
        model, corners = self._world()
        found = poses.photographs(model, "images")
        places = [
            {
                "file_path": one.name,
                "mask_path": masks.mask_file(Path("masks"), one.name).as_posix(),
                **frame_keys(one.camera),
                "k1": one.distortion.k1,
            }
            for one in found
        ]
        with atomic_folder(self.scene / "sparse") as unfinished:
            (unfinished / "0").mkdir()
            model.write(unfinished / "0")
        with atomic_path(self.scene / "points.ply") as unfinished:
            model.export_PLY(unfinished)
        write_json(
            self.scene / SINGLE,
            {
                "camera_model": "OPENCV",
                "ply_file_path": "points.ply",
                "aabb": corners.tolist(),
                "frames": places,
            },
        )
        return {"line": f"wrote {self.scene / SINGLE} with {len(found)} photographs"}

    def _world(self):
        """(pycolmap's model in the scene's world, (2, 3) box of the object there: the user's, if
        one was chosen in the page of `pp-cl view`).
        """
        model, found = needed("pycolmap").Reconstruction(self.model), self._found("box")
        _move(model, found["scale"], np.array(found["rotation"]), np.array(found["shift"]))
        edited = read_edits(self.scene).box
        return model, np.array(found["box"]) if edited is None else edited


def _move(model, scale, rotation, shift):
    """Move pycolmap's model by a similarity."""
    colmap = needed("pycolmap")
    model.transform(colmap.Sim3d(scale, colmap.Rotation3d(rotation), shift))


def _seen_from_outside(model, box):
    """The picture of a model's points and cameras, and a box (2, 3), from two sides."""
    cameras = [one.camera for one in poses.photographs(model, "images")]
    colours = np.array([point.color for point in model.points3D.values()])
    return overview(cameras, box, poses.points(model)[0], colours, SHOWN_WIDTH)


def _left_out(lines: Sequence[str], what: str) -> str:
    """`; 3 left out: A, B and 1 more`, empty without lines."""
    return f"; {len(lines)} {what}: {listing(lines)}" if lines else ""


def _distance(cameras, world):
    eyes = world.points(np.stack([camera.eye for camera in cameras]))
    return float(np.median(np.linalg.norm(eyes, axis=1)))
