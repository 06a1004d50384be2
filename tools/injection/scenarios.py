"""The faults: each scenario takes a Bench and gives a Tally for each kind of case it has tried."""

import errno
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from tools.injection.bench import Bench, Case, Place, Tally
from tools.injection.trial import (
    complaints,
    content,
    copied,
    differences,
    eval_words,
    half_written,
    leftovers,
    train_words,
)

ERRORS = (errno.ENOSPC, errno.EIO)  # in turn
# A process that goes on after these has lost a lock or a descriptor that its end would free.
IN_A_CHILD = ("flock", "close")
FULL_AT = (0, 8, 40, 100, 180, 240, 300, 360, 420, 500)  # KiB that a new run may take
ENDED = {signal.SIGTERM: (0, 143, -15), signal.SIGINT: (0, 130, -2)}  # statuses after a signal


def failing_calls(bench: Bench) -> Iterator[Tally]:
    """Each call that changes the run fails, in four commands."""
    evaluated = bench.template(bench.train, eval_words)
    for name, begin, words in (
        ("training", None, bench.train),
        ("training that goes on", bench.interrupted, bench.train),
        ("evaluation", bench.trained, eval_words),
        ("evaluation again", evaluated, eval_words),
    ):
        case = Case(bench, begin, words)
        numbers = range(1, len(case.calls) + 1)
        yield fail_calls(case, f"each call fails once, {name}", numbers)


def fail_calls(case: Case, fault: str, numbers: Iterable[int]) -> Tally:
    """Each of these calls of a command fails in a run of its own."""
    tally = Tally(fault)

    def fail(place, number):
        kind = case.calls[number - 1].split()[0]
        error = ERRORS[number % 2]
        outcome = case.disturb(place, in_child=kind in IN_A_CHILD, call=number, error=error)
        wrong = complaints(outcome, (0, 2))
        if not any(call.startswith("! ") for call in outcome.calls):
            wrong.append("the call did not come")
        if outcome.status == 0:
            wrong += differences(place.run_folder, case.expected)
        return number, outcome, wrong + case.after(place, may_leave=kind == "remove")

    for number, outcome, wrong in case.bench.each(fail, numbers):
        tally.add(outcome, f"call {number} ({case.calls[number - 1]})", wrong)
    return tally


def kills(bench: Bench) -> Iterator[Tally]:
    """SIGKILL, half at random moments, half in front of random calls, again and again."""
    few = max(1, bench.kills // 5)
    for name, begin, words, count in (
        ("training", None, bench.train, bench.kills),
        ("evaluation", bench.trained, eval_words, few),
    ):
        yield _killed(Case(bench, begin, words, in_child=True), f"SIGKILL, {name}", count)


def _killed(case, fault, count):
    bench, tally = case.bench, Tally(fault)
    shares = [count // len(bench.places)] * len(bench.places)
    shares[0] += count - sum(shares)

    def chain(place, share):
        number, share = share
        return _kill_chain(case, place, np.random.default_rng((bench.seed, count, number)), share)

    for results in bench.each(chain, enumerate(shares)):
        for moment, outcome, wrong in results:
            tally.add(outcome, moment, wrong)
    return tally


def _kill_chain(case, place, rng, count):
    """[(moment, outcome, what is wrong)] of as many kills; the command is given again after each,
    and anew after it has come to its end.
    """
    results, run = [], place.run_folder
    copied(case.begin, run)
    while len(results) < count:
        if rng.random() < 0.5:
            seconds = rng.uniform(0, case.seconds)
            moment, faults = f"{seconds:.3f} s", {"signals": [(seconds, signal.SIGKILL)]}
        else:
            number = int(rng.integers(1, len(case.calls) + 1))
            moment, faults = f"before call {number}", {"call": number}
        outcome = place.run(case.words(run), in_child=True, **faults)
        wrong = half_written(run) if run.exists() else []
        if outcome.status == -signal.SIGKILL:
            results.append((moment, outcome, wrong))
            continue
        wrong += complaints(outcome, (0,)) + differences(run, case.expected) + leftovers(run)
        if wrong:
            results.append((f"no kill at {moment}", outcome, wrong))
        copied(case.begin, run)
    wrong = case.after(place, may_leave=True)
    if results:
        results[-1][2].extend(wrong)
    return results


def stops(bench: Bench) -> Iterator[Tally]:
    """SIGTERM, Ctrl-C, and Ctrl-C twice, at random moments."""
    for name, begin, words in (
        ("training", None, bench.train),
        ("evaluation", bench.trained, eval_words),
    ):
        case = Case(bench, begin, words, in_child=True)
        for label, numbers in (
            ("SIGTERM", [signal.SIGTERM]),
            ("Ctrl-C", [signal.SIGINT]),
            ("Ctrl-C twice", [signal.SIGINT] * 2),
        ):
            yield _stopped(bench, case, f"{label}, {name}", numbers)


def _stopped(bench, case, fault, numbers):
    tally, rng = Tally(fault), np.random.default_rng((bench.seed, *map(int, numbers)))

    def stop(place, moments):
        signals = list(zip(moments, numbers, strict=True))
        outcome = case.disturb(place, in_child=True, signals=signals)
        wrong = complaints(outcome, ENDED[numbers[0]])
        killed = outcome.status < 0 or len(numbers) > 1  # as Python ends at once
        return moments, outcome, wrong + case.after(place, may_leave=killed)

    first = [rng.uniform(0, case.seconds) for _ in range(bench.stops)]
    moments = [[t + 0.1 * i for i in range(len(numbers))] for t in first]
    for times, outcome, wrong in bench.each(stop, moments):
        tally.add(outcome, " and ".join(f"{t:.3f} s" for t in times), wrong)
    return tally


# --------------------------------------------------------------------------------------------------


@contextmanager
def mounted(folder: Path) -> Iterator[Callable[[str], None]]:
    """A file system in memory at `folder`; what is given changes its options. Raises
    CalledProcessError where that is not allowed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _system("mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", folder)
    try:
        yield lambda options: _system("mount", "-o", f"remount,{options}", folder)
    finally:
        _system("umount", "-l", folder)


def _system(*words):
    words = [str(word) for word in words]
    subprocess.run(words, check=True, capture_output=True)


def full_disks(bench: Bench) -> Iterator[Tally]:
    """A disk that becomes full and stays so until there is space again."""
    for name, begin, words in (
        ("training", None, bench.train),
        ("evaluation", bench.trained, eval_words),
    ):
        case, tally = Case(bench, begin, words), Tally(f"full disk, {name}")
        place = bench.places[0].moved(bench.folder / "disk")
        with mounted(place.folder) as remount:
            for size in FULL_AT if begin is None else FULL_AT[:4]:
                copied(begin, place.run_folder)
                taken = sum(p.lstat().st_blocks * 512 for p in place.folder.rglob("*"))
                remount(f"size={taken + size * 1024 + 4096}")
                outcome = place.run(words(place.run_folder))
                remount("size=64m")
                wrong = complaints(outcome, (0, 2)) + case.after(place)
                tally.add(outcome, f"{size} KiB", wrong)
        yield tally


def read_only(bench: Bench) -> Iterator[Tally]:
    """A run that may be read and not written."""
    tally = Tally("read-only folder")
    place, elsewhere = bench.places[0].moved(bench.folder / "disk"), bench.places[0].run_folder
    evaluated = bench.template(bench.train, eval_words)
    with mounted(place.folder) as remount:
        for name, begin, words in (
            ("a new run", None, bench.train),
            ("a run to go on with", bench.interrupted, bench.train),
            ("evaluation", bench.trained, eval_words),
            ("evaluation with --out", bench.trained, partial(_eval_into, elsewhere)),
        ):
            remount("rw")
            copied(begin, place.run_folder)
            before = content(place.run_folder)
            remount("ro")
            copied(None, elsewhere)
            outcome = place.run(words(place.run_folder))
            wrong = complaints(outcome, (0,) if "--out" in name else (2,))
            wrong += differences(place.run_folder, before)
            if "--out" in name:
                wrong += differences(elsewhere, _below(content(evaluated), "eval/"))
            if "hull:" in outcome.out:
                wrong.append("noticed after the hull")
            tally.add(outcome, name, wrong)
    yield tally


def _eval_into(out, run):
    return [*eval_words(run), "--out", str(out)]


def _below(files, folder):
    return {n.removeprefix(folder): data for n, data in files.items() if n.startswith(folder)}


def lost_scenes(bench: Bench) -> Iterator[Tally]:
    """The scene goes while it is trained on, and is not there at the next start."""
    tally, place = Tally("scene lost"), bench.places[0]
    scene, run = place.folder / "scene", place.run_folder
    shutil.copytree(bench.scene, scene)
    case = Case(bench, None, partial(train_words, scene))

    def lose():
        while not (run / "log.jsonl").exists():
            time.sleep(0.01)
        scene.rename(place.folder / "gone")

    copied(None, run)
    loser = threading.Thread(target=lose, daemon=True)
    loser.start()
    outcome = place.run(case.words(run))
    loser.join()
    wrong = complaints(outcome, (0,)) + differences(run, case.expected)
    tally.add(outcome, "while it trains", wrong)
    for name, begin, words in (
        ("training", None, case.words),
        ("evaluation", run, eval_words),
    ):
        there = place.moved(place.folder / f"lost {name}")
        copied(begin, there.run_folder)
        before = content(there.run_folder)
        outcome = there.run(words(there.run_folder))
        wrong = complaints(outcome, (2,)) + differences(there.run_folder, before)
        tally.add(outcome, name, wrong)
    yield tally


def two_writers(bench: Bench) -> Iterator[Tally]:
    """Two trainings begin in one folder at about the same time: one goes on, or the second finds a
    finished run.
    """
    case, tally = (
        Case(bench, None, bench.train, in_child=True),
        Tally("two trainings into one folder"),
    )
    first, rng = bench.places[0], np.random.default_rng(bench.seed)
    second = Place(bench.library, first.folder)
    for _ in range(bench.stops):
        copied(None, first.run_folder)
        delay = rng.uniform(0, 0.5 * case.seconds)
        with ThreadPoolExecutor(1) as pool:
            words = case.words(first.run_folder)
            other = pool.submit(first.run, words, in_child=True)
            time.sleep(delay)
            outcomes = [second.run(words, in_child=True), other.result()]
        wrong = [line for o in outcomes for line in complaints(o, (0, 2))]
        if all(outcome.status for outcome in outcomes):
            wrong.append("neither went on")
        wrong += differences(first.run_folder, case.expected) + leftovers(first.run_folder)
        tally.add(max(outcomes, key=lambda o: o.status), f"{delay:.3f} s apart", wrong)
    second.close()
    yield tally


def clock_backwards(bench: Bench) -> Iterator[Tally]:
    """The time of day runs backwards, in front of a training and of an evaluation."""
    tally, place = Tally("clock that runs backwards"), bench.places[0]
    for name, begin, words in (
        ("training", None, bench.train),
        ("evaluation", bench.trained, eval_words),
    ):
        case = Case(bench, begin, words)
        outcome = case.disturb(place, in_child=True, is_backwards=True)
        wrong = complaints(outcome, (0,)) + differences(place.run_folder, case.expected)
        tally.add(outcome, name, wrong)
    yield tally


# {name on the command line: scenario}
SCENARIOS = {
    "calls": failing_calls,
    "kills": kills,
    "stops": stops,
    "full": full_disks,
    "read-only": read_only,
    "scene": lost_scenes,
    "writers": two_writers,
    "clock": clock_backwards,
}
