"""`pp-cl info`: facts about a run or a scene."""

import argparse
import math

from pp_cl.commands import options as shared
from pp_cl.errors import UserError, few_names
from pp_cl.presets import PRESETS

HELP = "describe a run or a scene; --picture draws its points over photographs"
MASKS = ("masks", "ignore", "mask_from")
MIB = 2**20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("subject", metavar="RUN|SCENE", help="folder of a run or of a scene, or the word demo")
    shared.add_json(parser)
    add(
        "--picture",
        type=shared.output_file(".png"),
        metavar="FILE",
        help="write photographs with outlines of points and masks (PNG)",
    )
    add(
        "--work",
        action="store_true",
        help="of a run: count in some views what is computed, beside all of a dense grid and image",
    )
    add("--preset", choices=PRESETS, help="of a scene: preset of the hull (tiny)")
    shared.add_short(parser, MASKS)
    shared.add_set(parser, "of a scene: another setting, such as scene.box")
    shared.add_run_scene(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Print the facts, write the image. Raises UserError for options that do not fit, and for a
    scene whose cameras are wrong.
    """
    from pp_cl.commands.info_facts import describe_scene, run_facts, run_sheet, run_work
    from pp_cl.config import nearby_run
    from pp_cl.drivers import open_device
    from pp_cl.files.image import write_png
    from pp_cl.run import find_run
    from pp_cl.scene.outline import outline_sheet

    folder, image = find_run(options.subject), None
    is_misspelt = not folder.path.exists() and nearby_run(folder.path)
    if folder.config.exists() or is_misspelt:
        shared.refuse(options, (*MASKS, "set", "preset"), "only of a scene")
        facts = run_facts(folder, options.scene)
        if options.work:
            facts["work"] = run_work(open_device(options.device), folder)
        if options.picture:
            image = run_sheet(open_device(options.device), folder, options.scene)
        rows = _run_rows(facts)
    else:
        shared.refuse(options, ("scene", "work"), "only of a run")
        dev = open_device(options.device)
        given = shared.read_short(options, MASKS) + options.set
        preset_name = options.preset or "tiny"
        facts, views, hull, disagreements = describe_scene(dev, options.subject, preset_name, given)
        if options.picture:
            image = outline_sheet(dev, views, hull, disagreements)
        rows = _scene_rows(facts)
    lines = [f"{name:12s}{text}" for name, text in rows]
    if image is not None:
        write_png(options.picture, image)
        facts["picture"] = options.picture
        lines.append(f"wrote {options.picture}")
    shared.tell(options.json, facts, lines)
    if facts.get("cameras_are_wrong"):  # train raises the same
        raise UserError(facts["problem"])


# ---- facts as rows: (subject of a line, "" if it is that of the line before, text)


def _run_rows(facts):
    state = "finished" if facts["finished"] else "not finished"
    reduced = f", images reduced {facts['downscale']:g} times" * (facts["downscale"] > 1)
    needing = "train, eval, compare and render --path test or val"
    gone = "" if facts["scene_is_there"] else f" (not there; {needing} need it)"
    rows = [
        ("run", f"{facts['run']}, preset {facts['preset']}"),
        ("scene", f"{facts['scene']}{gone}{reduced}"),
        ("training", f"step {facts['step']} of {facts['iterations']}, {state}"),
    ]
    if facts["seconds"] is not None:
        where = f" on {facts['device']}" if facts["device"] else ""
        rows.append(("", f"{facts['seconds']:.1f} s{where}"))
    if facts["psnr"] is not None:
        rows.append(("", f"PSNR {facts['psnr']:.2f} in the last logged step"))
    for i, why in enumerate(facts["decisions"].values()):
        rows.append(("" if i else "decisions", why))
    network = facts["network"]
    widths = ", ".join(map(str, network["widths"]))
    shape = f"{widths} channels, {network['blocks']} blocks"
    if facts["points"]:
        initial, points_left = facts["points"]["initial"], facts["points"]["left"]
        pruned = facts["points"]["pruned"]
        after = f", after prunings {', '.join(map(str, pruned))}" if pruned else ""
        rows += [
            ("network", f"{shape}, {network['parameters']} parameters"),
            ("views", f"{_sizes(facts['views']['images'])}, kept with their cameras"),
            *(("", note) for note in facts["notes"]),
            ("points", f"{points_left} ({initial} at the start{after})"),
            ("grid", _grid_text(facts["grid"])),
            ("cells", _cells_text(facts["cells"])),
        ]
        rows += _work_rows(facts["work"]) if facts["work"] else []
    else:
        rows += [("network", shape), ("checkpoint", "none yet")]
    values = ", ".join(f"{name} {value:.4f}" for name, value in (facts["metrics"] or {}).items())
    step = facts["metrics_step"]
    early = f" (unfinished, at step {step})" * (step is not None and step < facts["iterations"])
    files = ", ".join(f"{name} {_bytes(size)}" for name, size in facts["files"].items())
    return [
        *rows,
        ("test views", f"{values or 'not evaluated yet'}{early}"),
        ("files", f"{files}; {_bytes(sum(facts['files'].values()))} in all"),
    ]


def _cells_text(cells):
    box, hull, filled = (cells[name] for name in ("box", "hull", "left"))
    return (
        f"{box} in the box, {hull / box:.1%} of them in the hull, {filled / box:.1%} with a point;"
        f" all of them would make the checkpoint {_bytes(cells['box_bytes'])},"
        f" not {_bytes(cells['checkpoint_bytes'])}"
    )


def _work_rows(work):
    fragments, step, network = work["fragments"], work["step"], work["network"]
    count, done, whole = fragments["found"], network["multiplications"], network["whole"]
    crop = f"crop of {step['side']} pixels" if step["side"] else "step"
    share, billions = f"{done / whole:.1%}", f"{whole / 1e9:.2f} billion multiplications"
    return [
        ("a view", f"{work['drawn']:.0f} points drawn (means of {work['views']} views)"),
        ("", f"{count:.0f} fragments, {fragments['blended'] / count:.1%} of them blended"),
        ("", f"fragments in {network['tiles']:.1%} of the network's tiles, {share} of {billions}"),
        ("a step", f"{step['touched']:.0f} points with gradients in a {crop}"),
        ("", f"{step['with_gradients']:.0f} fragments with gradients"),
    ]


def _scene_rows(facts):
    splits = ", ".join(f"{name} {count}" for name, count in facts["splits"].items())
    angle_x, angle_y = (_range(facts["field_of_view"][axis], ".1f") for axis in "xy")
    masks, stated, dropped = facts["masks"], facts["depth_range"], facts["dropped"]
    # decimals of world units that show four digits of the cameras' distances
    distances = facts["distances"]
    places = max(0, 3 - math.floor(math.log10(max(distances) or 1)))
    form = f".{places}f"
    share = "" if masks["object"] is None else f", {masks['object']:.1%} of the image is object"
    rejecting = [
        f"{mask['view']}: its mask rejects {mask['share']:.0%} of what others agree on"
        for mask in masks["disagreeing"]
    ] + [
        f"{name}: its camera or mask contradicts the others; it is left out"
        for name in masks.get("left_out", {})
    ]
    rows = [
        ("scene", f"{facts['scene']}, format {facts['format']}"),
        ("splits", splits),
        *(("", note) for note in facts["notes"]),
        (
            "images",
            f"{_sizes(facts['images'])}; preset {facts['preset']}: reduced"
            f" {facts['downscale']:g} times",
        ),
        ("focal", f"{_range(facts['focal_pixels'], '.1f')} pixels"),
        ("view", f"{angle_x} x {angle_y} degrees"),
        ("masks", f"{masks['with_alpha']:.0%} of the training views have one{share}"),
        *(("", text) for text in rejecting),
        ("depth range", _range(stated, form) if stated else "none stated"),
        ("cameras", f"{_range(distances, form)} from {_vector(facts['looked_at'], places)}"),
        ("up", f"{_vector(facts['up'])} (estimated)"),
    ]
    if facts["box"]:
        rows.append(("given box", _box(facts["box"], places)))
    if dropped:
        rows.append(("dropped", f"{few_names(dropped)} (pp_cl.json)"))
    hull = facts["hull"]
    if hull is None:
        why = "the cameras are wrong" if facts["cameras_are_wrong"] else facts["problem"]
        return [*rows, ("hull", f"none: {why}")]
    capped = " (capped)" * hull["capped"]
    rows.append(("hull", f"{hull['points']} points{capped}, {_grid_text(hull)}"))
    if masks["with_alpha"]:
        strictly = ", if none is forgiven" * (masks["forgiven"] > 0)
        rows.append(("", f"{hull['masks_beside']:.2%} of the masks lie beside it{strictly}"))
    if times := hull["refinements"]:
        pixels = " and ".join(
            f"{hull['voxel_size_pixels'] / 2**n:.2f}" for n in range(1, times + 1)
        )
        rows.append(("", f"to be refined to {pixels} pixels"))
    if masks["forgiven"]:
        many = f"up to {masks['forgiven']} masks may reject a point"
        rows.append(("", f"{many}, as they contradict each other"))
    return [*rows, ("box", _box(hull["box"], places))]


def _sizes(images):
    return ", ".join(f"{count} of {size}" for size, count in images.items())


def _bytes(count):
    return f"{count / MIB:.1f} MiB" if count >= MIB / 10 else f"{count / 1024:.1f} KiB"


def _grid_text(grid):
    dims, voxel_size = "x".join(map(str, grid["dims"])), f"voxel size {grid['voxel_size']:.6g}"
    return f"{dims}, {voxel_size} ({grid['voxel_size_pixels']:.2f} pixels)"


def _range(values, form):
    """One number, or two with `to` between them."""
    low, high = (format(value, form) for value in values)
    return low if low == high else f"{low} to {high}"


def _vector(values, places=3):
    """(x, y, z), without the sign of -0.000."""
    return "(" + ", ".join(f"{round(value, places) + 0.0:.{places}f}" for value in values) + ")"


def _box(corners, places):
    return " to ".join(_vector(corner, places) for corner in corners)
