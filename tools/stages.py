"""Time a training's steps by stage, next to the time that the stage's bytes and multiplications
need; also time a step that does not wait for its stages, and the host's part of it.

    python -m tools.stages SCENE --out RUN [--preset P] [--json FILE]

A finished run goes on for some steps with its final points; without a run in RUN a training starts.
Nothing is written there. A stage that only moves data is compared with a copy of the bytes that it
must read or write once, the network with its multiplications as direct convolutions. Both speeds
are measured in the same process.
"""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

from pp_cl.bench.timing import interleave
from pp_cl.bench.training import host_cost
from pp_cl.config import run_config
from pp_cl.drivers import open_device
from pp_cl.engine.network.layers import multiplications
from pp_cl.engine.network.unet import UNet
from pp_cl.errors import UserError
from pp_cl.files.atomic import write_json
from pp_cl.files.run_folder import RunFolder
from pp_cl.session.training import open_training, stored_state
from tools.peak import CopyBandwidth, PeakFlops

UNTIMED, TIMED = 4, 15  # steps; the first ones build kernels and grow buffers
WORD, ROW = 4, 64  # bytes of a number, and of a point's or pixel's 16 features


def least_bytes(n: int, visible: int, pairs: int, shown: int, pixels: int, sh: int) -> dict:
    """{stage: bytes that it must read or write once}.

    n: points. visible: those that show in a sample. pairs: of a point and a tile. shown: those
    where the point shows. sh: bytes of a point's SH coefficients.
    """
    cloud = 5 * WORD  # id and offset
    record = 8 * WORD
    key = 2 * WORD
    moved = 5 * WORD  # gradient; parameter and second moment, read and written
    return {
        "project": n * (cloud + WORD) + visible * record,
        "pairs": visible * record + 3 * pairs * key,
        "weights": pairs * key + shown * key + visible * record + 2 * pixels * WORD,
        "shade": visible * (sh + ROW),
        "blend": shown * key + visible * (record + ROW) + pixels * ROW,
        "backward": shown * (key + 2 * (ROW + record))
        + visible * 2 * (ROW + record)
        + pixels * ROW,
        "update": visible * (2 * sh + 3 * ROW + 2 * WORD + 5 * moved),
    }


def counts(result) -> dict:
    """The arguments of least_bytes() that depend on a rendered view."""
    pairs, weights = result.pairs, result.weights
    shown = int(weights.tile_shown.get().sum())
    found = {"visible": weights.visible.size, "pairs": pairs.total, "shown": shown}
    return found | {"n": len(result.points.point_count), "pixels": pairs.pixels}


def measure(scene: str, out: Path, preset: str | None) -> dict:
    """{"points", "size", "copy_gbs", "gflops", "launches": in a step, "stages": [{"stage", "ms",
    "least_ms"}]}; times are medians of the timed steps. Raises UserError as `pp-cl train` does.
    """
    folder, steps, given = RunFolder(out), UNTIMED + 2 * TIMED, []
    if folder.checkpoint.exists():
        made = json.loads(folder.config.read_text("utf-8"))["train"]["iterations"]
        given = [("train.iterations", made + steps, "stages")]
    config = run_config(folder, scene, preset, given)
    dev = open_device()
    trainer = open_training(dev, folder, config, stored_state(folder, config)).trainer
    net, cloud, per_step = trainer.model.net, trainer.model.cloud, []
    sh, backward = sum(array.nbytes for array in cloud.sh) // cloud.count, trainer.renderer.backward

    def watched(result, grad_image, **options):
        products = multiplications(net.layers, *result.size) * result.computed_fraction
        per_step.append(least_bytes(**counts(result), sh=sh) | {"products": products})
        return backward(result, grad_image, **options)

    for _ in range(UNTIMED):
        trainer.train_step()
    dev.finish()
    start = time.perf_counter()
    host = host_cost(trainer, TIMED)
    dev.finish()
    step = (time.perf_counter() - start) / TIMED
    trainer.renderer.backward = watched  # set after host_cost(), as it reads counts back
    with dev.timed_stages() as seconds:
        for _ in range(TIMED):
            trainer.train_step()
    copy, peak = CopyBandwidth(dev), PeakFlops(dev)
    times = interleave({"copy": copy.run, "peak": peak.run})
    copied = copy.bytes / statistics.median(times["copy"])  # bytes a millisecond
    computed = peak.flops / statistics.median(times["peak"])
    need = {name: statistics.median(row[name] for row in per_step) for name in per_step[0]}
    network = 2 * need.pop("products") / computed  # a multiply-add counts as two
    least = {name: moved / copied for name, moved in need.items()}
    least |= {"network": network, "network backward": 2 * network}
    rows = [
        {"stage": name, "ms": 1e3 * statistics.median(taken)}
        | ({"least_ms": least[name]} if name in least else {})
        for name, taken in seconds.items()
        if len(taken) >= TIMED  # omits stages of some steps only: pairs found anew for lack of room
    ]
    unsplit = {"step without waits": 1e3 * step, "host's time in it": host["host_ms"]}
    rows += [{"stage": name, "ms": ms} for name, ms in unsplit.items()]
    padded, _, _ = trainer.crops.draw(0).camera.padded(UNet.multiple)
    return {
        "points": cloud.count,
        "size": f"{padded.width}x{padded.height}",
        "copy_gbs": copied * 1e-6,
        "gflops": computed * 1e-6,
        "launches": host["launches"],
        "stages": rows,
    }


def main() -> int:
    """Measure, print and write the results; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("scene", help="folder of a scene, or demo")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="a run, if any")
    parser.add_argument("--preset", help="of a training that begins (tiny)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result there too")
    options = parser.parse_args()
    try:
        result = measure(options.scene, options.out, options.preset)
    except UserError as error:
        print(f"stages: {error}", file=sys.stderr)
        return 2
    print("{points:,} points, {size}, {launches} launches".format_map(result))
    print("{copy_gbs:.1f} GB/s, {gflops:.0f} GFLOP/s".format_map(result))
    for row in result["stages"]:
        least = f"{row['least_ms']:8.2f}" if "least_ms" in row else ""
        print(f"{row['stage']:18} {row['ms']:8.2f} {least}")
    if options.json:
        write_json(options.json, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
