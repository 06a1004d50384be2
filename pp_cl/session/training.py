"""Begins or resumes a training in the folder of a run, with log, previews and checkpoints."""

import math
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pp_cl.checkpoint import (
    check_finite,
    load_run_state,
    opened_run,
    progress_of,
    save_checkpoint,
)
from pp_cl.config import configure, load_config, refuse_setting
from pp_cl.drivers import open_device
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.model import Model
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.points import PointCloud
from pp_cl.engine.step import Trainer
from pp_cl.engine.stored import (
    load_model,
    model_arrays,
    model_header,
    restore_training,
    training_arrays,
)
from pp_cl.engine.training.schedule import has_passed
from pp_cl.engine.views import View
from pp_cl.errors import Diverged, UserError
from pp_cl.files.atomic import check_room, check_target
from pp_cl.files.image import to_8bit, write_png
from pp_cl.files.run_folder import MASKS_SHEET, RunFolder
from pp_cl.files.sheets import write_comparison
from pp_cl.metrics.psnr_ssim import psnr
from pp_cl.presets import SHORT
from pp_cl.progress import Progress
from pp_cl.run import Run, load
from pp_cl.scene.identity import difference, identity
from pp_cl.scene.listing import list_split, measured_split
from pp_cl.scene.load import open_scene
from pp_cl.session.clock import MEASURED_AT, Clock, seconds_after
from pp_cl.session.decide import as_decided, config_of, decide, decide_growth, followed, least
from pp_cl.session.memory import Memory, Place
from pp_cl.session.start import begin_network, sheet_of_masks
from pp_cl.settings import Config

PREVIEWS = 4  # that a training writes, besides an early one
FIRST_PREVIEW = 10.0  # seconds; even after a slow step and its writing, it shows within 20
MEASURED_VIEWS = 4
Stored = tuple[dict[str, Any], dict[str, np.ndarray]]  # header and arrays of a checkpoint
OnStep = Callable[[int, dict[str, Any] | None], None]


class HullFacts(NamedTuple):
    """Facts about a new training's hull. forgiven: how many masks may reject a point. sheet: an
    image of the masks that disagree with the others, None if all agree.
    """

    forgiven: int
    sheet: np.ndarray | None


@dataclass
class Training:
    """A training that is ready to begin or to go on. config: its settings, which change with its
    decisions. info: what a checkpoint's header holds besides the model's entries. hull: None if it
    resumes. measured: the views on which train.eval_every measures PSNR. seconds: of its steps so
    far. began: time.monotonic() when it was opened, less the time before an interruption;
    train.minutes count from there. on_preview: called after each preview but the last, if set.
    clock: of train.minutes, None without.
    """

    folder: RunFolder
    config: Config
    trainer: Trainer
    info: dict[str, Any]
    memory: Memory
    hull: HullFacts | None
    measured: list[View]
    seconds: float
    began: float
    on_preview: Callable[[], None] | None = field(default=None, init=False)
    _preview_by: float = field(default=math.inf, init=False)  # time.monotonic()'s seconds
    _save_by: float = field(default=math.inf, init=False)
    _saved: int = field(default=0, init=False)  # step of the last checkpoint; 0: there is none
    clock: Clock | None = field(default=None, init=False)

    @property
    def passed(self) -> float:
        """Seconds of train.minutes that have passed, including those before an interruption."""
        return time.monotonic() - self.began

    @property
    def place(self) -> Place:
        """The points at present."""
        model = self.trainer.model
        return Place(model.grid, model.cloud.count, model.depth_range)

    def memory_line(self) -> str:
        """The memory that the training takes at most from now on, as text."""
        config = followed(self.config, self.trainer.begun)
        return self.memory.line(self.memory.need(config, self.place, self.trainer.progress))

    def run(
        self,
        on_step: OnStep | None = None,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> float:
        """Train to the end with log, previews and checkpoints; returns the seconds of training,
        including those before an interruption. on_step(step, row) is called after each step; row is
        the step's row of the log, or None. If is_stopped() is true then, a checkpoint is written
        and the training ends. Raises UserError if another process trains into the folder, and
        if numbers are no longer finite; the last
        checkpoint is kept.
        """
        with self.folder.owned():
            self._check_unchanged()
            self.folder.create(self.config.to_json())
            if self.hull and self.hull.sheet is not None:
                write_png(self.folder.path / MASKS_SHEET, self.hull.sheet)
            self._saved = self.trainer.step
            size = sum(array.nbytes for array in training_arrays(self.trainer).values())
            check_room(self.folder.checkpoint, size)
            try:
                return self._run(on_step, is_stopped)
            except Diverged as error:
                kept = f"{self.folder.checkpoint} of step {self._saved} is kept"
                raise UserError(
                    f"{error}; {kept if self._saved else 'nothing was kept'}: train into another"
                    " --out with a lower network.rate or train.sh_rate"
                ) from None
            finally:  # they refer to this, so that nothing would be freed
                self.trainer.clock = self.trainer.make_room = None

    def _check_unchanged(self):
        """Raise UserError if another process has trained into the folder since it was opened."""
        step = 0
        if self.folder.checkpoint.exists():
            with opened_run(self.folder, self.config) as stored:
                step = stored.header["step"]
        if step != self.trainer.step:
            raise UserError(
                f"{self.folder}: another training has gone on to step {step} meanwhile;"
                " give the command again"
            )

    def _run(self, on_step, is_stopped):
        trainer = self.trainer
        with self.folder.open_log(trainer.step) as log:
            train, first = self.config.train, trainer.step + 1
            self.seconds = max(self.seconds, log.seconds)  # a finished run's are in its log alone
            trainer.make_room = self._make_room
            if train.minutes and not trainer.begun:
                given = 60 * train.minutes / train.members
                self.clock = Clock(given, lambda: self.passed, trainer.progress, trainer.steps)
                trainer.clock = self._told
            self._expect_save()
            while trainer.progress < 1:
                before, start, rates = trainer.progress, time.perf_counter(), trainer.rates()
                terms = trainer.train_step()
                self.seconds += time.perf_counter() - start
                if trainer.step == first and not any(self.folder.previews.glob("*.png")):
                    self._preview_by = time.monotonic() + FIRST_PREVIEW  # the kernels are built
                row = self._after_step(log, terms, rates, before)
                if on_step:
                    on_step(trainer.step, row)
                if is_stopped() and trainer.progress < 1:
                    self._save(finished=False)
                    return self.seconds
            check_finite(training_arrays(trainer))  # before the EMA replaces the parameters
            start = time.perf_counter()
            trainer.finish()
            self.seconds += time.perf_counter() - start
            # Before the checkpoint: a log row without its checkpoint is made again by resuming,
            # but a finished run is not resumed.
            row = self._row() | {"points": trainer.model.cloud.count, "finished": True}
            log.write(row | ({"specular": trainer.fitted.scale} if trainer.fitted else {}))
            self._save(finished=True)
        return self.seconds

    def _told(self, step):
        """Trainer.clock of a training with train.minutes."""
        progress = self.clock(step)
        self.trainer.steps = self.clock.steps
        return progress

    def _make_room(self, before):
        """Before more memory is taken: decide what to give up for lack of it, or of time, and store
        that in config.json. before: the progress before the last step.
        """
        trainer, steps_left = self.trainer, self.clock.steps_left if self.clock else None
        config, given_up = decide_growth(
            self.config,
            self.memory,
            self.place,
            trainer.views,
            trainer.begun,
            progress=(before, trainer.progress),
            steps_left=steps_left,
        )
        for what in given_up:
            warnings.warn(f"step {trainer.step}: for lack of memory, {what}", stacklevel=2)
        if config.decisions != self.config.decisions:
            self.config = config
            trainer.follow(followed(config, trainer.begun))
            self.folder.configure(config.to_json())
        if self.clock:
            self.clock.begins_anew()

    def _after_step(self, log, terms, rates, before):
        """Write the row of the log, the preview and the checkpoint if due, in this order; return
        the row. rates, before: the step's, and the progress before it.
        """
        trainer, train = self.trainer, self.config.train
        step, last, row = trainer.step, trainer.progress >= 1, None
        is_measured = train.eval_every and step % train.eval_every == 0
        measured = self._measure() if is_measured else {}
        if step % train.log_every == 0 or last or is_measured:
            state = {"points": trainer.model.cloud.count, "rates": vars(rates)}
            row = self._row() | terms.get() | state | measured
            log.write(row)
        due = any(has_passed(n / PREVIEWS, before, trainer.progress) for n in range(1, PREVIEWS))
        if last or due or time.monotonic() >= self._preview_by:
            self._preview()
            if self.on_preview and not last:
                self.on_preview()
        due = step % train.checkpoint_every == 0 or time.monotonic() >= self._save_by
        if due and not last:
            self._save(finished=False)
        if self.clock and has_passed(MEASURED_AT, before, trainer.progress):
            for _ in range(2):  # the first one may build kernels
                start = time.perf_counter()
                trainer.render(trainer.views[0])
                looking = time.perf_counter() - start
            self.clock.reserve(seconds_after(train, len(trainer.views), looking, trainer.steps))
        return row

    def _row(self):
        device = self.trainer.dev.name
        return {"step": self.trainer.step, "seconds": round(self.seconds, 3), "device": device}

    def _measure(self):
        """{"test_psnr": mean PSNR of the present model's 8-bit images of the measured views}."""
        psnrs = []
        for view in self.measured:
            image = self._rendered(view)
            truth = view.ignoring(self.trainer.target(view), image)
            psnrs.append(psnr(to_8bit(image), to_8bit(truth)))
        return {"test_psnr": float(np.mean(psnrs))}

    def _expect_save(self):
        """Set the time of the next checkpoint; the clock influences nothing else."""
        minutes = self.config.train.checkpoint_minutes
        self._save_by = time.monotonic() + 60 * minutes if minutes else math.inf

    def _save(self, finished):
        trainer = self.trainer
        if self.clock:  # first, so that it never has fewer steps than the checkpoint
            steps = trainer.step if finished else max(trainer.step + 1, round(trainer.steps))
            train = replace(self.config.train, iterations=steps)
            self.config = replace(self.config, train=train)
            self.folder.configure(self.config.to_json())
        header = (
            model_header(trainer.model) | self.info | {"step": trainer.step, "finished": finished}
        )
        if not finished:
            header |= {"progress": trainer.progress}
            header |= {"seconds": round(self.seconds, 3), "passed": round(self.passed, 3)}
        header |= {"exposed": trainer.exposed} if trainer.exposed else {}
        header |= {} if finished else {"averaged": bool(trainer.optimiser.averages)}
        arrays = model_arrays(trainer.model) if finished else training_arrays(trainer)
        save_checkpoint(self.folder.checkpoint, header, arrays)
        self._expect_save()
        self._saved = trainer.step

    def _preview(self):
        """Write prediction, truth and error of the first training view."""
        trainer, view = self.trainer, self.trainer.views[0]
        self._preview_by = math.inf
        path = self.folder.previews / f"step_{trainer.step:06d}.png"
        write_comparison(path, [self._rendered(view)], [trainer.target(view)])

    def present_run(self) -> Run:
        """The model trained so far as a Run, to be rendered between two steps. It uses the
        trainer's renderer, as one of its own would freeze the network.
        """
        trainer = self.trainer
        header = self.info | {"step": trainer.step, "progress": trainer.progress}
        header["finished"] = False
        run = Run(trainer.dev, self.folder, self.config, header, trainer.model)
        run.renderer = trainer.renderer
        return run

    def _rendered(self, view):
        """The present model's image of a view. Raises Diverged if it is not finite."""
        image = self.trainer.render(view)
        if not np.isfinite(image).all():
            raise Diverged(f"the image of {view.name} holds NaN after step {self.trainer.step}")
        return image


# ---- beginning and resuming: nothing is written


def open_training(
    dev: Device, folder: RunFolder, config: Config, stored: Stored | None
) -> Training:
    """Open the training in `folder`. With a checkpoint `stored` it resumes there; a finished one is
    extended with new moments and without refinements. Without one it begins with the decisions of
    its hull and memory. Raises UserError for a scene that is broken or not the
    checkpoint's, for too little memory, and for a folder that cannot be written.
    """
    header, arrays = stored or ({"step": 0}, {})
    began = time.monotonic() - header.get("passed", 0.0)
    check_target(folder.config)
    folder.check_sheets(header["step"])
    begun = header["step"] if header.get("finished") else header.get("extended_from", 0)

    net = UNet.of_settings(dev, config.network) if stored else begin_network(dev, config)
    split_files = list_split(config.scene.path)
    memory, progress = Memory(config, net, split_files.image_files), 0.0
    if stored:
        progress = progress_of(header | {"finished": False}, config.train.iterations)
        points = Grid.of_header(header["grid"]), len(arrays["points.ids"]), header["depth_range"]
        memory.check(least(config, progress), Place(*points), progress)
    else:
        memory.check(least(config))
    scene = open_scene(dev, config, ("train",), listed={"train": split_files})
    views, facts = scene.splits["train"], None
    info = identity(views) | ({"notes": scene.notes} if scene.notes else {})
    if stored:
        _check_scene(folder, config, header, views)
        model = load_model(dev, header, arrays, net, degree=config.points.sh_degree)
        left_out = header.get("left_out", [])
        views = [view for view in views if view.name not in left_out]
        info["initial_points"] = header["initial_points"]
    else:
        with Progress("carving the visual hull"):
            config, agreement, hull, depth_range = decide(dev, config, views, memory)
            sheet = sheet_of_masks(dev, views, hull, agreement)
            facts = HullFacts(agreement.forgiven, sheet)
        cloud = PointCloud.create(dev, hull.ids, config.points.sh_degree, config.points.opacity)
        model = Model(dev, hull.grid, depth_range, cloud, net=net)
        views, left_out = agreement.views, list(agreement.left_out)
        info["initial_points"] = model.cloud.count
    trainer = Trainer(dev, followed(config, begun), model, views)
    if stored:
        state = header["step"], arrays, begun, header.get("exposed", ""), progress
        restore_training(trainer, *state)
    info |= {"extended_from": begun} if begun else {}
    info |= {"left_out": left_out} if left_out else {}
    measured = []
    if config.train.eval_every:
        split = measured_split(config.scene.path)
        measured = open_scene(dev, config, (split,), most=MEASURED_VIEWS).splits[split]
    seconds = header.get("seconds", 0.0)
    return Training(folder, config, trainer, info, memory, facts, measured, seconds, began)


def _check_scene(folder, config, header, views):
    """Raise UserError if a checkpoint's training views are not those of the scene."""
    mismatch = difference(header, list_split(config.scene.path, edited=False).image_files, views)
    if not mismatch and {view.name for view in views} != {name for name, _ in header["views"]}:
        mismatch = "views were dropped or taken back since, as `pp-cl view` shows"
    if mismatch:
        raise UserError(
            f"{folder.checkpoint}: belongs to another scene than {config.scene.path} ({mismatch});"
            " use another --out"
        )


def train_scene(
    scene: str,
    out: Path | str,
    preset: str | None = None,
    device: str | None = None,
    *,
    settings: dict[str, Any] | None = None,
    on_step: OnStep | None = None,
    is_stopped: Callable[[], bool] | None = None,
    **options: Any,
) -> Run:
    """Train a scene into the folder `out`, or go on with the run there; a finished run is left
    alone unless it has fewer iterations than asked for. scene: a folder, or the word demo. device:
    as `pp-cl train --device`. settings: {"section.key": value}; options: settings by the names of
    the command's options, such as iterations. on_step, is_stopped: passed to Training.run(). Raises
    UserError.
    """
    unknown = set(options) - set(SHORT)
    if unknown:
        raise TypeError(f"train_scene() has no {min(unknown)}; it has {', '.join(SHORT)}, settings")
    settings = {SHORT[name]: value for name, value in options.items()} | (settings or {})
    folder = RunFolder(out)
    given = [(*s, "settings") for s in settings.items()]
    config = config_of(folder, str(scene), preset, given, device)
    dev, is_stopped = open_device(device), is_stopped or (lambda: False)
    for member, member_config in members(folder, config):
        stored = stored_state(member, member_config)
        if not is_finished(stored, member_config):
            open_training(dev, member, member_config, stored).run(on_step, is_stopped)
        if is_stopped():
            break
    return load(out, dev)


# ---- the settings asked for, and the runs that exist


def stored_state(folder: RunFolder, config: Config) -> Stored | None:
    """(header, arrays) of the folder's checkpoint, or None. If the scene of a finished run has
    moved, config.json is updated. Raises UserError for a folder or checkpoint that does not fit.
    """
    folder.check_usable()
    there = load_config(folder.config) if folder.config.exists() else config
    stored = load_run_state(folder, there) if folder.checkpoint.exists() else None
    if stored is None or is_finished(stored, config):
        now = config.scene.path
        if there.scene.path != now:
            if stored is None or difference(stored[0], list_split(now, edited=False).image_files):
                refuse_setting(folder, "scene.path", there.scene.path, now)
            folder.configure(configure(there, now).to_json())
    return stored


def members(folder: RunFolder, config: Config) -> Iterator[tuple[RunFolder, Config]]:
    """Yield the run in a folder, then its further members. Each of these has the decisions
    that the first has by then, and the next seed. An unfinished one comes twice: it ends with its
    own.
    """
    yield folder, config
    if config.train.members > 1:
        first = load_config(folder.config)
        config = as_decided(config, first)
        config.train.iterations = first.train.iterations
    for i in range(1, config.train.members):
        seed = (config.train.seed + i) % 2**32
        train = replace(config.train, seed=seed, members=1, minutes=0.0)
        member = folder.member(i + 1)
        if member.checkpoint.exists():
            begun = configure(load_config(member.config), config.scene.path)
            with opened_run(member, begun) as run:
                finished = run.header["finished"]
            if not finished:
                yield member, begun
        yield member, replace(config, train=train)


def is_finished(stored: Stored | None, config: Config) -> bool:
    """Whether there is a checkpoint after which no step is left to train."""
    return stored is not None and stored[0]["step"] >= config.train.iterations
