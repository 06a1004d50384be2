"""Surfaces of words and of other files: the command line, --set, the environment, meshes, pictures
to compare, sweeps, messages of the viewer.
"""

import os
import subprocess
import sys

import numpy as np
import trimesh
from PIL import Image

from pp_cl.cli import COMMANDS
from pp_cl.config import Config, sections
from pp_cl.files.run_folder import RunFolder
from pp_cl.metrics.compare import compare
from pp_cl.metrics.shape import overlap, read_mesh, sample_surface
from pp_cl.presets import RENAMED
from pp_cl.run_config import run_config
from pp_cl.scene.grid import Grid
from pp_cl.scene.readers.frame import frame_keys
from pp_cl.sweep.plan import plan, read_seeds, read_varied
from pp_cl.view.messages import read_request
from tools.fuzz.binary import changed_bytes
from tools.fuzz.files import changed_tree
from tools.fuzz.judge import Case, Finding, check, check_numbers
from tools.fuzz.runs import check_config, check_run_files
from tools.fuzz.scenes import check_camera
from tools.fuzz.templates import ball_views, set_words
from tools.fuzz.values import TEXTS, brief, changed_json, changed_text, dumps, odd_text

LONG = 40  # seconds that the program itself has
# {option: words that it may have}, of commands that end soon
OPTIONS = {
    "eval": ("--split", "--metrics", "--tolerance", "--device", "--scene", "--json"),
    "info": ("--picture", "--preset", "--scene", "--set", "--mask-from", "--masks", "--json"),
    "render": ("--path", "--size", "--fov", "--seconds", "--fps", "--samples", "--background"),
    "export": ("--format", "--out", "--min-weight"),
    "compare": ("--metrics", "--json", "--device"),
    "shape": ("--mesh", "--edge", "--samples", "--json", "--scene"),
    "train": ("--points", "--downscale", "--seed", "--memory", "--preset", "--eval-every"),
    "sweep": ("--seeds", "--vary", "--set", "--preset", "--workers", "--metrics", "--json"),
    "devices": ("--json",),
    "bench": ("--size", "--widths", "--tau", "--gamma", "--budget", "--blend"),
    "compress": ("--quality", "--out"),
}
# what makes a command end soon, whatever else it is told
SHORTENED = {
    "render": ("--seconds", "0.1", "--fps", "10"),
    "sweep": ("--dry-run",),
    "train": set_words(train__iterations=1),
    "bench": ("peak", "--size", "x"),
    "shape": ("--samples", "100"),
}
SOON = ("tune", "view", "selftest", "compress")  # would take long: with --help or a stray word only
KEYS = [f"{section}.{name}" for section, values in sections(Config()) for name in vars(values)]


def command_line(case: Case) -> None:
    """A command with odd words."""
    rng, world = case.rng, case.world
    name = rng.choice([*OPTIONS, *OPTIONS, *COMMANDS, odd_text(rng)])
    words = [name, *_subjects(rng, world, case.folder, name)]
    for _ in range(rng.choice([0, 1, 1, 2])):
        option = rng.choice([*OPTIONS.get(name, ("--help",)), odd_text(rng)])
        words += [option] if rng.random() < 0.1 else [option, odd_text(rng)]
    words += ["--no-such"] if name in SOON else SHORTENED.get(name, ())
    words = [word.replace("\0", "") for word in words]  # no process starts with such a word
    case.label = brief(" ".join(words[1:]))
    kept = os.getcwd()
    os.chdir(case.folder)  # words may name files
    try:
        case.command(*words)
    finally:
        os.chdir(kept)


def _subjects(rng, world, folder, name):
    """What a command works on."""
    scene, run = world.scenes["transforms"], world.finished
    if rng.random() < 0.2:
        return [odd_text(rng)]
    if name == "train":
        return [str(scene), "--out", str(folder / "out") if rng.random() < 0.8 else odd_text(rng)]
    if name == "sweep":
        return [str(scene), "--out", str(folder / "sweep")]
    if name == "compare":
        return [str(scene / "train"), str(scene / "train")]
    if name in ("devices", "bench"):
        return []
    copied = world.copied_run(run, folder)
    return [str(copied)]


def settings(case: Case) -> None:
    """--set of any keys; what is believed is within limits, and now and then trained with."""
    rng, world = case.rng, case.world
    pairs = []
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        key = rng.choice([*KEYS, *KEYS, *RENAMED, *TEXTS])
        pairs.append((key, odd_text(rng), "--set"))
    case.label = brief(" ".join(f"{key}={text}" for key, text, _ in pairs))
    folder, scene = RunFolder(case.folder / "out"), str(world.scenes["transforms"])
    config = case.read(lambda: run_config(folder, scene, None, pairs))
    if config is None:
        return
    check_config(config)
    small = config.points.count < 10**4 and max(config.network.widths) < 64
    if small and rng.random() < 0.2:
        words = [word for key, text, _ in pairs for word in ("--set", f"{key}={text}")]
        shortened = set_words(train__iterations=2)
        if case.command("train", scene, "--out", folder, *words, *shortened) == 0:
            check_run_files(folder.path)


def environment(case: Case) -> None:
    """Variables that pp-cl or its libraries read; one in ten through the program itself."""
    rng, world = case.rng, case.world
    name = rng.choice(["PP_DEVICE", "PP_DEBUG", "PP_MAX_ALLOCATION", "PP_CACHE"])
    text = odd_text(rng).replace("\0", "")
    if rng.random() < 0.3:
        text = rng.choice(["/proc/nothing", "/dev/null", str(case.folder / "a b"), "relative", "/"])
    text = text.encode("utf-8", "surrogateescape")[:30_000].decode("utf-8", "ignore")
    case.label = f"{name}={brief(text)}"
    words = rng.choice([["devices"], ["eval", world.copied_run(world.finished, case.folder).path]])
    if rng.random() < 0.03:
        _program(case, words, name, text)
        return
    before = os.environ.get(name)
    os.environ[name] = text
    try:
        case.command(*words)
    finally:
        os.environ.pop(name)
        os.environ |= {} if before is None else {name: before}


def _program(case, words, name, text):
    """Run the program itself with a variable."""
    if case.rng.random() < 0.5:  # without a cache the kernels of a rendering are built for minutes
        name, words = case.rng.choice(["XDG_CACHE_HOME", "HOME", "TMPDIR"]), ["devices"]
    else:
        name = case.rng.choice([name, "LC_ALL", "PYTHONIOENCODING"])
    case.label = f"program {name}={brief(text)}"
    if name == "PYTHONIOENCODING":
        text = case.rng.choice(["ascii", "latin-1", "utf-16"])
    done = subprocess.run(
        [sys.executable, "-m", "pp_cl", *map(str, words)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), name: text},
        cwd=case.folder,
        capture_output=True,
        timeout=LONG,
        check=False,
    )
    last = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:]
    if done.returncode not in (0, 2):
        raise Finding(f"the program's exit status {done.returncode}: {last}")
    if done.returncode == 2 and not last[0].startswith("pp-cl"):
        raise Finding(f"the program's last line: {last[0][:100]}")


# --------------------------------------------------------------------------------------------------


def mesh(case: Case) -> None:
    """A file of a mesh, for pp-cl shape."""
    rng = case.rng
    kind = rng.choice(["ply", "ply", "obj", "stl", "off", "glb", "txt", "xyz", "3mf", "dae", "zip"])
    ball = trimesh.creation.icosphere(subdivisions=1)
    written = kind if kind in ("ply", "obj", "stl", "off", "glb") else "ply"
    options = {"encoding": "ascii"} if written == "ply" and rng.random() < 0.5 else {}
    data = ball.export(file_type=written, **options)
    data = data.encode() if isinstance(data, str) else data
    is_text = written in ("obj", "off") or bool(options)
    case.label, data = (changed_text if is_text and rng.random() < 0.7 else changed_bytes)(
        rng, data
    )
    file = case.folder / f"ball.{kind}"
    file.write_bytes(data)
    case.label = f"{file.name} {case.label}"
    read = case.read(lambda: read_mesh(file))
    if read is None:
        return
    check(np.isfinite(read.vertices).all(), "vertices that are not finite")
    check(read.faces.min() >= 0 and read.faces.max() < len(read.vertices), "faces of no vertices")
    grid = Grid((-1.0, -1.0, -1.0), 0.25, (9, 9, 9))
    surface = case.read(lambda: sample_surface(case.world.device, read, grid, 2000))
    if surface is not None:
        check(0 < surface.count <= 2000, f"{surface.count} vertices on a surface")
        found = overlap(surface, grid, np.arange(9**3))
        shares = {"iou": found.iou, "recall": found.recall, "precision": found.precision}
        check(all(0 <= share <= 1 for share in shares.values()), f"{shares}")


def pictures(case: Case) -> None:
    """Two images or folders of images to compare."""
    rng = case.rng
    folders = [case.folder / "a", case.folder / "b"]
    size = rng.choice([(1, 1), (6, 6), (11, 11), (16, 16), (13, 40)])
    for folder in folders:
        folder.mkdir()
        for i in range(rng.choice([1, 2, 2])):
            pixels = np.frombuffer(rng.randbytes(size[0] * size[1] * 3), np.uint8)
            Image.fromarray(pixels.reshape(*size, 3)).save(folder / f"{i}.png")
    file = rng.choice(sorted(folders[0].iterdir()))
    if rng.random() < 0.3:
        case.label = changed_tree(rng, file)
    elif rng.random() < 0.5:
        case.label, data = changed_bytes(rng, file.read_bytes())
        file.write_bytes(data)
    result = case.read(lambda: compare(*folders))
    if result:
        for row in [result["mean"], *result["per_image"]]:
            check_numbers({key: row[key] for key in ("psnr", "ssim")}, "metrics")
            check(-1 <= row["ssim"] <= 1, f"SSIM {row['ssim']}")


def sweeps(case: Case) -> None:
    """What a sweep is told, and what it finds in its folder."""
    rng, scene = case.rng, str(case.world.scenes["transforms"])
    varied = [
        f"{rng.choice([*KEYS, *TEXTS])}{rng.choice(['=', '=', '=', ''])}{odd_text(rng)}"
        for _ in range(rng.choice([0, 1, 1, 2]))
    ]
    seeds = rng.choice(["0", "1,2", odd_text(rng)])
    case.label = brief((varied, seeds))
    scenes = rng.choice([[scene], [scene, scene], [scene, odd_text(rng)], ["demo", "DEMO"]])

    def planned():
        return plan(scenes, case.folder / "out", read_seeds(seeds), read_varied(varied))[0]

    jobs = case.read(planned) or []
    for job in jobs:
        inside = os.path.realpath(job.folder).startswith(
            os.path.realpath(case.folder / "out") + "/"
        )
        check(inside, f"a run outside of --out: {job.folder}")
        check(type(job).from_json(job.to_json()) == job, "a run that is another when it is sent")
    check(len({job.folder for job in jobs}) == len(jobs), "two runs in one folder")


def messages(case: Case) -> None:
    """A message of a tab of the viewer."""
    rng = case.rng
    camera = frame_keys(ball_views()["train"][0].stored_camera)
    message = {
        "kind": "frame", "number": 3, "show": "colour", "draft": False, "camera": camera,
        "tau": 0.0, "early_stop": 0.0, "kept": 1, "exposure": 0,
    }  # fmt: skip
    case.label, message = changed_json(rng, message, ("w", "h", "fl_x", "tau"))
    data = dumps(message)
    if rng.random() < 0.2:
        case.label, data = changed_text(rng, data)
    request = case.read(lambda: read_request(data.decode("utf-8", "replace")))
    if request is not None:
        check_camera(request.camera)
        numbers = {
            name: getattr(request, name) for name in ("tau", "early_stop", "kept", "exposure")
        }
        check_numbers(numbers, "request")


SURFACES = {
    "command_line": command_line,
    "settings": settings,
    "environment": environment,
    "mesh": mesh,
    "pictures": pictures,
    "sweep": sweeps,
    "messages": messages,
}
