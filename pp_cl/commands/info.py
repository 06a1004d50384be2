"""`pp-cl info`: facts about a run or a scene."""

import argparse

from pp_cl.commands import options as shared
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
        help="write photographs with outlines of points and masks, of a scene also the cameras from"
        " two sides (PNG)",
    )
    add("--preset", choices=PRESETS, help="of a scene: preset of the hull (tiny)")
    shared.add_short(parser, MASKS)
    shared.add_set(parser, "of a scene: another setting, such as scene.box")
    shared.add_run_scene(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Print the facts, write the picture. Raises UserError for options that do not fit."""
    from pp_cl.commands.info_facts import describe_scene, run_facts, run_picture, scene_picture
    from pp_cl.config import nearby_run
    from pp_cl.drivers import open_device
    from pp_cl.files.image import write_png
    from pp_cl.files.run_folder import RunFolder
    from pp_cl.scene.load import DEMO

    folder = RunFolder(options.subject)
    is_scene = options.subject == DEMO or folder.path.exists() or not nearby_run(folder.path)
    is_run = folder.config.exists() or not is_scene
    if is_run:
        shared.refuse(options, (*MASKS, "set", "preset"), "only of a scene")
    else:
        shared.refuse(options, ("scene",), "only of a run")
    image = None
    if is_run:
        facts = run_facts(folder, options.scene)
        if options.picture:
            image = run_picture(open_device(options.device), folder, options.scene)
    else:
        dev = open_device(options.device)
        given = shared.read_short(options, MASKS) + options.set
        facts, views, hull, found = describe_scene(
            dev, options.subject, options.preset or "tiny", given
        )
        if options.picture:
            image = scene_picture(dev, options.subject, facts, views, hull, found)
    lines = (_run_lines if is_run else _scene_lines)(facts)
    if image is not None:
        write_png(options.picture, image)
        facts["picture"] = options.picture
        lines.append(f"wrote {options.picture}")
    shared.tell(options.json, facts, lines)


def _sizes(images):
    return ", ".join(f"{count} of {size}" for size, count in images.items())


def _bytes(count):
    return f"{count / MIB:.1f} MiB" if count >= MIB / 10 else f"{count / 1024:.1f} KiB"


def _line(name, text):
    return f"{name:12s}{text}"


def _grid_text(grid):
    dims, edge = "x".join(map(str, grid["dims"])), f"voxel size {grid['edge']:.6g}"
    return f"{dims}, {edge} ({grid['edge_pixels']:.2f} pixels)"


def _run_lines(facts):
    state = "finished" if facts["finished"] else "not finished"
    reduced = f", images reduced {facts['downscale']} times" * (facts["downscale"] > 1)
    needing = "train, eval, compare and render --path test or val"
    gone = "" if facts["scene_is_there"] else f" (not there; {needing} need it)"
    lines = [
        _line("run", f"{facts['run']}, preset {facts['preset']}"),
        _line("scene", f"{facts['scene']}{gone}{reduced}"),
        _line("training", f"step {facts['step']} of {facts['iterations']}, {state}"),
    ]
    if facts["seconds"] is not None:
        where = f" on {facts['device']}" if facts["device"] else ""
        lines.append(_line("", f"{facts['seconds']:.1f} s{where}"))
    if facts["psnr"] is not None:
        lines.append(_line("", f"PSNR {facts['psnr']:.2f} in the last logged step"))
    network = facts["network"]
    widths = ", ".join(map(str, network["widths"]))
    lines.append(_line("network", f"{widths} channels, {network['blocks']} blocks"))
    if facts["points"]:
        lines[-1] += f", {network['parameters']} parameters"
        initial, left = facts["points"]["initial"], facts["points"]["left"]
        lines += [
            _line("views", f"{_sizes(facts['views']['images'])}, kept with their cameras"),
            *(_line("", note) for note in facts["notes"]),
            _line("points", f"{left} ({initial} at the start)"),
            _line("grid", _grid_text(facts["grid"])),
        ]
    else:
        lines.append(_line("checkpoint", "none yet"))
    measured = facts["metrics"] or {}
    values = ", ".join(f"{name} {value:.4f}" for name, value in measured.items())
    step = facts["metrics_step"]
    early = f" (unfinished, at step {step})" * (step is not None and step < facts["iterations"])
    files = ", ".join(f"{name} {_bytes(size)}" for name, size in facts["files"].items())
    return [
        *lines,
        _line("test views", f"{values or 'not evaluated yet'}{early}"),
        _line("files", f"{files}; {_bytes(sum(facts['files'].values()))} in all"),
    ]


def _scene_lines(facts):
    splits = ", ".join(f"{name} {count}" for name, count in facts["splits"].items())
    reduced = f"preset {facts['preset']}: reduced {facts['downscale']} times"
    angle_x, angle_y = (_range(facts["field_of_view"][axis], ".1f") for axis in "xy")
    masks = facts["masks"]
    share = "" if masks["object"] is None else f", {masks['object']:.1%} of the image is object"
    stated = facts["depth_range"]
    return [
        _line("scene", f"{facts['scene']}, format {facts['format']}"),
        _line("splits", splits),
        *(_line("", note) for note in facts["notes"]),
        _line("images", f"{_sizes(facts['images'])}; {reduced}"),
        _line("focal", f"{_range(facts['focal_pixels'], '.1f')} pixels"),
        _line("view", f"{angle_x} x {angle_y} degrees"),
        _line("masks", f"{masks['with_alpha']:.0%} of the training views have one{share}"),
        *(
            _line("", f"{one['view']}: its mask rejects {one['share']:.0%} of what others agree on")
            for one in masks["disagreeing"]
        ),
        *(
            _line("", f"{name}: {share:.0%} of its mask lies beside the object; it is left out")
            for name, share in masks.get("left_out", {}).items()
        ),
        _line("depth range", _range(stated, ".3f") if stated else "none stated"),
        _line("cameras", f"{_range(facts['distances'], '.3f')} from {_vector(facts['looked_at'])}"),
        _line("up", f"{_vector(facts['up'])} (estimated)"),
        *_edit_lines(facts),
        *_hull_lines(facts),
    ]


def _edit_lines(facts):
    lines = []
    if facts["box"]:
        lines.append(_line("given box", " to ".join(map(_vector, facts["box"]))))
    if dropped := facts["dropped"]:
        more = f" and {len(dropped) - 3} more" * (len(dropped) > 3)
        lines.append(_line("dropped", f"{', '.join(dropped[:3])}{more} (pp_cl.json)"))
    return lines


def _hull_lines(facts):
    hull = facts["hull"]
    if hull is None:
        return [_line("hull", f"none: {facts['problem']}")]
    lines = [f"{hull['points']} points{' (capped)' * hull['capped']}, {_grid_text(hull)}"]
    if times := hull["refinements"]:
        pixels = " and ".join(f"{hull['edge_pixels'] / 2**n:.2f}" for n in range(1, times + 1))
        lines.append(f"to be refined to {pixels} pixels")
    if forgiven := facts["masks"]["forgiven"]:
        lines.append(f"up to {forgiven} masks may reject a point, as they contradict each other")
    low, high = map(_vector, hull["box"])
    return [
        *(_line("" if index else "hull", text) for index, text in enumerate(lines)),
        _line("box", f"{low} to {high}"),
    ]


def _range(values, form):
    """One number, or two with `to` between them."""
    low, high = (format(value, form) for value in values)
    return low if low == high else f"{low} to {high}"


def _vector(values):
    """(x, y, z), without the sign of -0.000."""
    return "(" + ", ".join(f"{round(value, 3) + 0.0:.3f}" for value in values) + ")"
