"""`pp-cl bench RUN`: renders a finished run at settings that trade time for error."""

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.layers.choice import AUTO, OFFERED, device_class
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.render import is_supersampled
from pp_cl.engine.training.target import Target
from pp_cl.engine.views import View, evenly
from pp_cl.errors import UserError
from pp_cl.metrics.psnr_ssim import Metrics, mean
from pp_cl.progress import Progress, track
from pp_cl.run import Run

EARLY_STOPS = 0.0, 0.001, 0.003, 0.01, 0.03, 0.1
SHARES = 1.0, 0.95, 0.9, 0.8, 0.7, 0.5, 0.3, 0.1  # shares of the points to keep
# At most MOST_VIEWS test views are rendered; if frames are slow, as many as a round of ROUND
# seconds allows, but at least LEAST_VIEWS. This many are timed repeatedly, for SECONDS in all.
MOST_VIEWS, LEAST_VIEWS, ROUND, SECONDS = 16, 4, 40.0, 40.0
# dB that single changes may lose in sum if they are to be tried together
TOGETHER = 0.08, 0.3, 1.0


@dataclass(frozen=True)
class Setting:
    """How a run is rendered.

    early_stop: as raster.early_stop. samples: per pixel, 1 or 4. points: share that is kept, by the
    highest visibility(). specular: whether the specular layer is applied. members: the image is the
    mean of this many. convolutions: their variant, a key of choice.VARIANTS or AUTO.
    """

    early_stop: float
    samples: int
    points: float
    specular: bool
    members: int
    convolutions: str


class Renderings:
    """A finished run, and the same run with other settings. default: its own setting. choices:
    {field of Setting: values that differ in time and error, the default's included}. Raises
    UserError for an unfinished run.
    """

    def __init__(self, run: Run) -> None:
        if not run.header["finished"]:
            step, steps = run.header["step"], run.config.train.iterations
            raise UserError(
                f"{run.folder}: is at step {step} of {steps}; finish it first with `pp-cl train"
                f" --out {run.folder}`"
            )
        self.run, self._members = run, [run, *run.others]
        raster = run.config.raster
        has_specular = any(member.model.specular for member in self._members)
        samples = run.renderer.supersampling**2
        count = len(self._members)
        self.default = Setting(raster.early_stop, samples, 1.0, has_specular, count, AUTO)
        self.choices: dict[str, tuple] = {
            "early_stop": tuple(sorted({*EARLY_STOPS, raster.early_stop})),
            "samples": (4, 1) if is_supersampled(raster) else (samples,),
            "points": SHARES,
            "specular": (True, False) if has_specular else (False,),
            "members": tuple(range(count, 0, -1)),
            "convolutions": (AUTO, *OFFERED[device_class(run.dev)]),
        }

    def settings(self) -> list[Setting]:
        """The exact setting, which is the default without an early stop; the default; the settings
        that differ from it in one field.
        """
        default = self.default
        settings = [replace(default, early_stop=0.0), default]
        for name, values in self.choices.items():
            settings += [replace(default, **{name: value}) for value in values]
        return list(dict.fromkeys(settings))

    def varied(self, setting: Setting, index: int = 0) -> Run:
        """The run, or a further member, with a setting; it has its own points and buffers."""
        run, rows, net, others = self._members[index], None, None, []
        if index == 0:
            others = [self.varied(setting, i) for i in range(1, setting.members)]
        if setting.points < 1:
            ranked = self._ranked[index]
            rows = np.sort(ranked[: max(1, round(setting.points * len(ranked)))]).astype(np.uint32)
        if setting.convolutions != AUTO:
            net = UNet.of_settings(run.dev, run.config.network)
            net.variant = setting.convolutions
            for name, parameter in run.model.net.parameters.items():
                run.dev.write(net.parameters[name], run.dev.download(parameter))
        return run.varied(
            rows=rows,
            early_stop=setting.early_stop,
            supersampling=math.isqrt(setting.samples),
            has_specular=setting.specular,
            net=net,
            others=others,
        )

    @cached_property
    def _ranked(self):
        """For each member, its points by visibility(), the highest first."""
        return [np.argsort(-visibility(member), kind="stable") for member in self._members]

    def words(self, setting: Setting) -> str:
        """How a setting differs from the default; for the default, its values."""
        texts = {
            "early_stop": f"early stop {setting.early_stop:g}",
            "samples": f"{setting.samples} sample{'s' * (setting.samples > 1)} a pixel",
            "points": f"{setting.points:.0%} of the points",
            "specular": "no specular layer",
            "members": f"{setting.members} of {self.default.members} members",
            "convolutions": f"convolutions: {setting.convolutions}",
        }
        if changed := self.changed(setting):
            return ", ".join(texts[name] for name in changed)
        return f"default: {texts['early_stop']}, {texts['samples']}"

    def changed(self, setting: Setting) -> list[str]:
        """The fields in which a setting differs from the default."""
        default = asdict(self.default)
        return [name for name, value in asdict(setting).items() if value != default[name]]


def visibility(run: Run) -> np.ndarray:
    """(N,) float64: the sum of each point's blend weights over the pixels of all training views. If
    a fifth of the points is left out by this sum, the demo loses 1.1 dB; by the highest sum in a
    single view, 1.6 dB.
    """
    dev, renderer, n = run.dev, run.renderer, run.model.cloud.count
    weight, times_seen, total = dev.zeros((n,)), dev.zeros((n,)), np.zeros(n)
    for camera in run.cameras("train"):
        drawn = renderer.forward(camera, run.gamma, until="weights")
        dev.fill(weight, 0)
        renderer.record_weights(drawn, weight, times_seen)
        total += dev.download(weight)
        del drawn  # frees its arrays before the next view needs larger ones
    renderer.release()
    return total


# ---- measuring


def measured(run: Run, metrics: tuple[str, ...] = ("psnr",)) -> dict[str, Any]:
    """Measure what `pp-cl bench RUN` shows: {"run", "device", "platform", "views": how many,
    "rows"}. A row: {"bench": "run", "knob": the field of
    Setting that differs from the default, "together" for several, "default" for none; "setting":
    all fields; "words"; "ms": median of a frame; "ms_range"; "max_err", "mean_err": errors of
    colours in [0, 1] against the exact rendering; the metrics against the photographs, means over
    the views; "is_default"; "is_frontier": no row with as high a PSNR, to 0.01 dB, is faster}.
    metrics: must include psnr. Raises UserError as Renderings
    and Run.scene() do.
    """
    renderings, dev = Renderings(run), run.dev
    rows = Measurement(renderings, run.scene("test").splits["test"], metrics).rows()
    about = {"run": str(run.folder), "device": dev.name, "platform": dev.info["platform"]}
    return about | rows


class Measurement:
    """Measures settings of a run on test views, in turns. metrics: as for measured()."""

    def __init__(
        self, renderings: Renderings, views: Sequence[View], metrics: tuple[str, ...]
    ) -> None:
        self._renderings, self._measure = renderings, Metrics(renderings.run.dev, metrics)
        self._views = evenly(views, MOST_VIEWS)
        self._ms: dict[Setting, list[float]] = {}
        self._found: dict[Setting, dict[str, float]] = {}
        self._exact: list[np.ndarray] = []

    def rows(self) -> dict[str, Any]:
        """The entries "views" and "rows" of measured()."""
        settings = self._renderings.settings()
        self._choose_views(len(settings))
        # the times of single changes show which are worth trying together
        for choose in (lambda: settings, self._together):
            for setting in track(choose(), "measuring", "setting"):
                self._judge(setting, self._render(setting, self._views))
            self._time(SECONDS / 2)
        return {"views": len(self._views), "rows": self._marked()}

    def _time(self, seconds):
        """Time all settings so far in turn, at least once."""
        views, end = evenly(self._views, LEAST_VIEWS), time.perf_counter() + seconds
        with Progress("timing"):
            while True:
                for setting in self._found:
                    self._render(setting, views, self._ms.setdefault(setting, []))
                if time.perf_counter() >= end:
                    return

    def _choose_views(self, count):
        """Keep only so many views that a round of `count` settings does not take too long."""
        run, camera = self._renderings.run, self._views[0].camera
        with Progress("building kernels"):
            frame(run, camera)
        start = time.perf_counter()
        frame(run, camera)
        most = int(ROUND / (count * (time.perf_counter() - start)))
        self._views = evenly(self._views, max(LEAST_VIEWS, most))
        release(run)
        target = Target(run.dev)
        self._truths = [target.whole(view) for view in self._views]

    def _render(self, setting, views, ms=None):
        """The images of the views. ms: a list to which each view's milliseconds are added."""
        run, images = self._renderings.varied(setting), []
        frame(run, views[0].camera)  # allocates the buffers
        for view in views:
            start = time.perf_counter()
            images.append(frame(run, view.camera))
            if ms is not None:
                ms.append((time.perf_counter() - start) * 1e3)
        release(run)
        return images

    def _judge(self, setting, images):
        """Store the errors of the images; the images of the first call are the exact ones."""
        self._exact = self._exact or images
        errors = [np.abs(a - b) for a, b in zip(images, self._exact, strict=True)]
        differences = {
            "max_err": max(float(error.max()) for error in errors),
            "mean_err": float(np.mean([error.mean(dtype=np.float64) for error in errors])),
        }
        rows = zip(images, self._views, self._truths, strict=True)
        self._found[setting] = differences | mean(
            [self._measure(image, view.ignoring(truth, image)) for image, view, truth in rows]
        )

    def _median(self, setting):
        return float(np.median(self._ms[setting]))

    def _together(self):
        """For each loss in TOGETHER, the fastest setting that differs in several fields, as
        predicted by adding up what each field alone gains and loses.
        """
        default = self._renderings.default
        ms, psnr = self._median(default), self._found[default]["psnr"]
        single: dict[str, list] = {}
        for setting in self._found:
            if setting.early_stop < default.early_stop or setting.samples > default.samples:
                continue  # it does more work
            for name in self._renderings.changed(setting):
                gains = ms - self._median(setting), psnr - self._found[setting]["psnr"]
                single.setdefault(name, [(getattr(default, name), 0.0, 0.0)]).append(
                    (getattr(setting, name), *gains)
                )
        tried = []
        for chosen in itertools.product(*single.values()):
            values, gained, lost = zip(*chosen, strict=True)
            setting = replace(default, **dict(zip(single, values, strict=True)))
            if len(self._renderings.changed(setting)) > 1:
                tried.append((sum(gained), sum(lost), setting))
        best = [
            max((t for t in tried if t[1] <= most), key=lambda t: t[0], default=(0, 0, None))
            for most in TOGETHER
        ]
        return list(dict.fromkeys(setting for gained, _, setting in best if gained > 0))

    def _marked(self):
        """The rows of measured()."""
        rows, renderings = [], self._renderings
        for setting, fields in self._found.items():
            changed, times = renderings.changed(setting), self._ms[setting]
            rows.append(
                {
                    "bench": "run",
                    "knob": (*changed, "default")[0] if len(changed) < 2 else "together",
                    "setting": asdict(setting),
                    "words": renderings.words(setting),
                    "ms": self._median(setting),
                    "ms_range": [min(times), max(times)],
                    **fields,
                    "is_default": not changed,
                }
            )
        for row in rows:
            as_good = [r for r in rows if round(r["psnr"], 2) >= round(row["psnr"], 2)]
            row["is_frontier"] = row is min(as_good, key=lambda r: r["ms"])
        return rows


def frame(run: Run, camera: Camera) -> np.ndarray:
    """(H, W, 3) float32 in [0, 1]: the image that the run shows to a camera."""
    between = run.depth_range(camera)
    return run.checked(run.shown(run.renderer.forward(camera, run.gamma, depth_range=between)))


def release(run: Run) -> None:
    """Free the buffers that a run's renderers keep from view to view."""
    for member in (run, *run.others):
        member.renderer.release()


# ---- the printed table

COLUMNS = "{:46} {:>8} {:>8} {:>8} {:>7}  {}".format
HEAD = COLUMNS("setting", "ms", "largest", "mean", "PSNR", "")


def line(row: dict) -> str:
    """A row of measured() as a line of the printed table."""
    marks = {"is_default": "the default", "is_frontier": "frontier"}
    more = [f"LPIPS {row['lpips']:.4f}"] if "lpips" in row else []
    more += [words for name, words in marks.items() if row[name]]
    figures = f"{row['ms']:.1f}", f"{row['max_err']:.1e}", f"{row['mean_err']:.1e}"
    return COLUMNS(row["words"], *figures, f"{row['psnr']:.2f}", ", ".join(more)).rstrip()
