"""Draw which parts of its scene a finished run computes: the cells of the hull and those with a
point, in the middle slice of the box, and the network's tiles in a view.

    python -m tools.needed RUN --out FILE.png

The run's scene must be there, as the hull is carved anew.
"""

import argparse
import sys

import numpy as np

from pp_cl import Run, load
from pp_cl.engine.layers.tiles import MAP_TILE
from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file
from pp_cl.scene.verdict import judged
from pp_cl.session.decide import first_hull

BOX, HULL, POINT = (0.93, 0.93, 0.93), (0.55, 0.75, 0.95), (0.85, 0.35, 0.1)
BESIDE = 0.35  # brightness of tiles that are not computed


def cells(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Which cells of the box are in the hull and which have a point, each (x, y, z) bool."""
    views = run.scene("train").splits["train"]
    hull, _ = first_hull(run.dev, run.config, judged(run.dev, run.config, views)[0])
    grid, masks = run.model.grid, []
    for of, ids in ((hull.grid, hull.ids), (grid, run.dev.download(run.model.cloud.ids))):
        is_there = np.zeros(of.dims, bool)
        is_there[tuple(of.coordinates(ids).T)] = True
        times = grid.dims[0] // of.dims[0]  # the grid was refined since
        masks.append(is_there.repeat(times, 0).repeat(times, 1).repeat(times, 2))
    return masks[0], masks[1]


def tiles(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """The first training view, padded for the network, (H, W, 3), and which pixels are in tiles
    that the network computes, (H, W) bool.
    """
    result = run.renderer.forward(run.cameras("train")[0], run.gamma)
    image = np.clip(run.dev.download(result.image), 0, 1)
    computed = np.ones([side // MAP_TILE for side in result.size], bool)
    if result.tile_mask is not None:
        plan = run.model.net.plan_tiles(result.size, result.tile_mask.get())
        computed = [*plan.maps.values()][-1].computed if plan else computed
    return image, computed.repeat(MAP_TILE, 0).repeat(MAP_TILE, 1)


def draw(run: Run, path: str) -> None:
    """Write the picture. Raises UserError as Run.scene() does."""
    from matplotlib.figure import Figure

    hull, points = cells(run)
    image, is_computed = tiles(run)
    middle = hull.shape[2] // 2
    carved, kept = hull[..., middle].T, points[..., middle].T
    layers = [np.where(carved[..., None], HULL, BOX)]
    layers.append(np.where(kept[..., None], POINT, layers[0]))
    layers.append(np.where(is_computed[..., None], image, BESIDE * image))
    share = f"{is_computed.mean():.0%}"
    titles = [f"hull: {hull.mean():.1%} of the box's {hull.size:,} cells"]
    titles += [f"points after pruning: {points.mean():.1%}", f"tiles of the network: {share}"]
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    for axes, layer, title in zip(figure.subplots(1, 3), layers, titles, strict=True):
        axes.imshow(layer, origin="upper" if layer is layers[2] else "lower")
        axes.set_title(title, fontsize=11)
        axes.set_axis_off()
    with atomic_file(path) as file:
        figure.savefig(file, format="png", dpi=100)


def main() -> int:
    """Draw the picture; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("run", metavar="RUN")
    parser.add_argument("--out", required=True, metavar="FILE")
    parser.add_argument("--scene", metavar="SCENE", help="where the run's scene is now")
    parser.add_argument("--device", metavar="D", help="as `pp-cl devices` prints them")
    options = parser.parse_args()
    try:
        draw(load(options.run, options.device, scene=options.scene), options.out)
    except UserError as error:
        print(f"needed: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
