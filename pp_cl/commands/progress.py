"""Shows the progress of a training."""

from contextlib import ExitStack
from typing import Any, TextIO

from tqdm import tqdm

from pp_cl.config import preset
from pp_cl.presets import FEW
from pp_cl.progress import Progress
from pp_cl.session.training import Training

BUILDING = 2  # steps that build nearly all kernels, if the driver has not kept them
TOLD = 10  # steps later, the number of steps that train.minutes allow is printed
GIB = 2**30


class TrainingProgress:
    """Shows rate, time left, PSNR, points and device memory of a training. Enter it for the time of
    the training, and call it after each step with its row of the log. The rate begins once kernels
    are built. With train.minutes it shows the minutes left.
    """

    def __init__(self, training: Training, stream: TextIO | None = None) -> None:
        self._dev, self._stream = training.trainer.dev, stream
        self._built = training.trainer.step + BUILDING
        self._training, self._steps = training, training.config.train.iterations
        self._test, self._stages = "", ExitStack()

    def __enter__(self) -> "TrainingProgress":
        self._shown = self._stages.enter_context(
            Progress("building kernels (once)", stream=self._stream)
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._stages.close()

    def __call__(self, step: int, row: dict[str, Any] | None) -> None:
        """Show a step."""
        train = self._training.config.train
        if step == self._built:
            self._stages.close()
            done: dict[str, Any] = {"total": self._steps, "unit": "step", "done": step}
            if minutes := train.minutes / train.members:
                done = {"given": minutes, "done": round(self._training.passed)}
            self._shown = self._stages.enter_context(
                Progress("training", **done, stream=self._stream)
            )
        elif step > self._built:
            self._shown.update()
        if self._training.clock and step == self._built + TOLD:
            self._tell_steps(train)
        if step > self._built and row is not None:
            if "test_psnr" in row:
                self._test = f" (test {row['test_psnr']:.2f})"
            memory = self._dev.bytes / GIB
            at = f"step {step}, " if train.minutes else ""
            self._shown.note = (
                f"{at}PSNR {row['psnr']:.2f}{self._test}, {row['points']} points, {memory:.2f} GiB"
            )

    def _tell_steps(self, train):
        """Print how many steps train.minutes allow if all take as long as the last ones."""
        name, steps = self._training.config.preset, round(self._training.trainer.steps)
        own, few = preset(name).train.iterations, FEW[name]
        text = f"{train.minutes:g} min: {name}, {steps} steps at this pace (its own are {own})"
        if steps < few:
            more = train.minutes * few / steps
            text += f"; with fewer than {few} it stays blurred: it needs some {more:.0f} minutes"
            text += ", or a smaller --preset" if name != next(iter(FEW)) else ""
        tqdm.write(text, self._stream)
