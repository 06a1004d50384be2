"""Where cases are tried: places for runs with their processes, what a command does undisturbed, and
the count of what was found.
"""

import errno
import shutil
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from tools.injection.trial import (
    complaints,
    content,
    copied,
    differences,
    half_written,
    leftovers,
    train_words,
)
from tools.injection.worker import Job, Outcome, Worker

Words = Callable[[Path], list[str]]  # command line of a run's folder


@dataclass
class Tally:
    """fault: in words. tried, stopped, went_on: cases, those that the fault ended, and those that
    it did not. findings: a line for each thing that was wrong.
    """

    fault: str
    tried: int = 0
    stopped: int = 0
    went_on: int = 0
    findings: list[str] = field(default_factory=list)

    def add(self, outcome: Outcome, case: str, wrong: Iterable[str]) -> None:
        """Count a case."""
        self.tried += 1
        self.stopped += outcome.status != 0
        self.went_on += outcome.status == 0
        self.findings += [f"{self.fault}, {case}: {line}" for line in wrong]


class Place:
    """A folder for the runs of cases, one at a time, and the processes that run them."""

    def __init__(self, library: Path, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._library, self.folder, self.run_folder = library, folder, folder / "run"

    @cached_property
    def warm(self) -> Worker:
        """Runs commands on a device that it keeps."""
        return Worker(self._library, forks=False)

    @cached_property
    def forking(self) -> Worker:
        """Runs commands in children."""
        return Worker(self._library, forks=True)

    def run(self, words: list[str], *, in_child: bool = False, **faults: Any) -> Outcome:
        """The outcome of a command. faults: as Job has them; run_folder is watched."""
        worker = self.forking if in_child else self.warm
        return worker.run(Job(words, str(self.run_folder), **faults))

    def moved(self, folder: Path) -> "Place":
        """The same processes with another folder."""
        other = Place(self._library, folder)
        vars(other).update(warm=self.warm, forking=self.forking)
        return other

    def close(self) -> None:
        """End the processes."""
        for name in vars(self).keys() & {"warm", "forking"}:
            getattr(self, name).close()


@dataclass
class Bench:
    """What the scenarios have.

    scene: a folder; library: the shim; folder: for all runs; side_by_side: places that work at a
    time. kills, stops: how many; seed: of their moments.
    """

    scene: Path
    library: Path
    folder: Path
    side_by_side: int
    kills: int = 200
    stops: int = 10
    seed: int = 0

    @cached_property
    def places(self) -> list[Place]:
        """Those that work side by side."""
        return [Place(self.library, self.folder / str(n)) for n in range(self.side_by_side)]

    def close(self) -> None:
        """End the processes of the places."""
        for place in self.places:
            place.close()

    @cached_property
    def train(self) -> Words:
        """The training."""
        return partial(train_words, self.scene)

    def template(self, *commands: Words) -> Path:
        """A folder beside the cases that undisturbed commands have left."""
        place = self.places[0]
        folder = Path(tempfile.mkdtemp(dir=self.folder))
        for words in commands:
            outcome = place.warm.run(Job(words(folder), str(folder)))
            if outcome.status:
                raise RuntimeError(f"an undisturbed command failed: {outcome.errors}")
        return folder

    @cached_property
    def trained(self) -> Path:
        """A finished run."""
        return self.template(self.train)

    @cached_property
    def interrupted(self) -> Path:
        """A run that was ended in front of its last checkpoint."""
        place = self.places[0]
        copied(None, place.run_folder)
        calls = place.run(self.train(place.run_folder)).calls
        last = max(n for n, call in enumerate(calls, 1) if call == "rename checkpoint.npz")
        copied(None, place.run_folder)
        place.run(self.train(place.run_folder), call=last, error=errno.ENOSPC)
        return Path(shutil.copytree(place.run_folder, self.folder / "interrupted"))

    def each(self, function: Callable[[Place, Any], Any], cases: Iterable[Any]) -> list[Any]:
        """function(place, case) of every case, as many at a time as there are places."""
        free = SimpleQueue()
        for place in self.places:
            free.put(place)

        def one(case):
            place = free.get()
            try:
                return function(place, case)
            finally:
                free.put(place)

        with ThreadPoolExecutor(len(self.places)) as pool:
            return list(pool.map(one, cases))


@dataclass
class Case:
    """What a command does to a copy of the folder `begin`, undisturbed: expected, calls, seconds.
    Folders from which the next start has come to the expected bytes are remembered: the same one
    need not be tried again.

    begin: None for nothing. in_child: as it is run to be timed.
    """

    bench: Bench
    begin: Path | None
    words: Words
    in_child: bool = False
    _seen: set = field(default_factory=set)

    def __post_init__(self):
        place = self.bench.places[0]
        copied(self.begin, place.run_folder)
        outcome = place.run(self.words(place.run_folder), in_child=self.in_child)
        self.expected, self.calls = content(place.run_folder), outcome.calls
        self.seconds = outcome.seconds
        if wrong := complaints(outcome, (0,)) + half_written(place.run_folder):
            raise RuntimeError(f"undisturbed: {wrong}")

    def disturb(self, place: Place, **faults: Any) -> Outcome:
        """The outcome on a new copy."""
        copied(self.begin, place.run_folder)
        return place.run(self.words(place.run_folder), **faults)

    def after(self, place: Place, *, may_leave: bool = False) -> list[str]:
        """What is wrong in the folder, and after the next start. may_leave: temporary files."""
        run = place.run_folder
        left = leftovers(run)
        wrong = half_written(run) + [f"left {name}" for name in left if not may_leave]
        state = (frozenset(content(run).items()) if run.exists() else None, bool(left))
        if state in self._seen:
            return wrong
        outcome = place.run(self.words(run))
        then = complaints(outcome, (0,)) + differences(run, self.expected) + leftovers(run)
        if not then:
            self._seen.add(state)
        return wrong + [f"the next start: {line}" for line in then]
