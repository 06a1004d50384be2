"""What a training step must at least take on three cards, from counted bytes and multiply-adds.

    python tools/gpu_estimate.py            # writes docs/results/gpu_estimate.json; then make docs

Nothing is measured: pp_cl/bench/estimate.py counts, and the cards' makers say the rates. What the
steps work on was counted on lego, on a CPU.
"""

import sys
from pathlib import Path

from pp_cl import __version__
from pp_cl.bench.estimate import Card, Counts, step_work
from pp_cl.config import preset
from pp_cl.files.atomic import write_json

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "gpu_estimate.json"
# Of their makers' data sheets, in single precision without matrix units: H200 SXM; the Radeon's
# rate is that of two operations at once, which few instructions reach.
CARDS = {
    "H200": Card(4.8e12, 66.9e12),
    "RX 7900 XTX": Card(960e9, 61.4e12),
    "Arc A770": Card(560e9, 19.7e12),
}
# {preset: what a step on lego works on}. paper: points that fill the hull, views of 800x800, 43 %
# of the network (docs/results/sparse_tiles.json). tiny: the first steps, images of 200x200.
COUNTS = {
    "paper": Counts(4_037_734, 7_393_774, 2_665_000, 800, 800, computed=0.43),
    "tiny": Counts(252_312, 572_705, 86_304, 128, 128),
}


def rows() -> list[dict]:
    """A row for each preset and stage, and one for the whole step: bytes, multiply-adds, launches,
    and milliseconds by card.
    """
    found = []
    for name, counts in COUNTS.items():
        stages, sums = step_work(preset(name), counts), dict.fromkeys(CARDS, 0.0)
        for stage, work in stages.items():
            seconds = {card: peaks.seconds(work) for card, peaks in CARDS.items()}
            sums = {card: sums[card] + seconds[card] for card in CARDS}
            found.append(_row(name, stage, work, seconds))
        totals = [sum(column) for column in zip(*stages.values(), strict=True)]
        found.append(_row(name, "step", type(work)(*totals), sums))
    return found


def _row(name, stage, work, seconds):
    row = {"preset": name, "stage": stage, "gigabytes": round(work.bytes / 1e9, 3)}
    row |= {"giga_multiply_adds": round(work.multiply_adds / 1e9, 3), "launches": work.launches}
    return row | {card: float(f"{value * 1e3:.3g}") for card, value in seconds.items()}


def results() -> dict:
    """docs/results/gpu_estimate.json."""
    columns = {
        "preset": "{preset}",
        "stage": "{stage}",
        "GB": "{gigabytes}",
        "10^9 multiply-adds": "{giga_multiply_adds}",
        "launches": "{launches}",
    }
    columns |= {f"{card}, ms": f"{{{card}}}" for card in CARDS}
    return {
        "estimated": "no card ran this: what the stages of a training step must at least take"
        " on lego, each the longer of its bytes at the card's bandwidth and its multiply-adds"
        " at its rate, and 5 us a launch",
        "version": __version__,
        "command": "python tools/gpu_estimate.py",
        "columns": [{"head": head, "cell": cell} for head, cell in columns.items()],
        "rows": rows(),
        "notes": [
            "; ".join(
                f"{card}: {peaks.bandwidth / 1e9:.0f} GB/s, {peaks.flops / 1e12:.1f} TFLOP/s"
                for card, peaks in CARDS.items()
            )
            + "."
        ],
    }


def main(path: Path = RESULTS) -> int:
    """Write the file; returns the exit status."""
    write_json(path, results())
    print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
