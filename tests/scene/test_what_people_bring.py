"""Scenes as other programs, phones and people leave them. Each trains, with a line about what was
done to it, or is refused with the reason. All show a ball.
"""

import json
import shutil
import unicodedata

import numpy as np
import pytest
from PIL import Image
from support.checkpoints import load_checkpoint
from support.runs import SETTINGS, set_words, spoken
from support.same_scene import held_out
from support.scenes import ball_image, ring_cameras, write_ball_scene

from pp_cl.commands.info_facts import describe_scene
from pp_cl.engine.views import View
from pp_cl.files.image import ORIENTATION
from pp_cl.scene.listing import list_split
from pp_cl.scene.readers.frame import GL_FROM_CV
from tools.convert_scene import convert

VIEWS = 14  # 12 of these are for training


def a_ball(folder, form):
    """Write the ball in a format, with masks in their own folder. Images are wider than high."""
    cameras = [camera.crop(0, 3, 48, 42) for camera in ring_cameras(VIEWS, 48)]
    views = [View(f"{i}.png", camera, ball_image(camera)) for i, camera in enumerate(cameras)]
    convert(held_out(views), folder, form)
    return folder


def frames(folder, change):
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    for i, frame in enumerate(data["frames"]):
        change(i, frame)
    file.write_text(json.dumps(data))


def frame_by_frame(key, value):
    def change(i, frame):
        frame[key] = value(i, frame[key])

    return lambda folder: frames(folder, change)


def gone(*names):
    return lambda folder: [(folder / name).unlink() for name in names]


def moved(*pairs):
    def move(folder):
        for old, new in pairs:
            (folder / new).parent.mkdir(parents=True, exist_ok=True)
            (folder / old).rename(folder / new)

    return move


def images(change, suffix=".png", names="images"):
    """A function that writes each image anew, as the result of change(image)."""

    def write(folder):
        for file in sorted((folder / names).iterdir()):
            image = change(Image.open(file).convert("RGB" if names == "images" else "L"))
            file.unlink()
            image.save(file.with_suffix(suffix), **image.info.get("options", {}))

    return write


def several_kinds(folder):
    for i, file in enumerate(sorted((folder / "images").iterdir())):
        image = Image.open(file).convert(("RGB", "RGB", "RGB", "CMYK")[i % 4])
        file.unlink()
        image.save(file.with_suffix((".tif", ".bmp", ".avif", ".jpg")[i % 4]))


def with_options(image, **options):
    image.info["options"] = options
    return image


def turned(image):
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    return with_options(image.transpose(Image.Transpose.ROTATE_90), exif=exif)


def workspace(folder):
    """Make the workspace of COLMAP's automatic reconstruction with the photographs elsewhere: a
    model of distorted images, and one of as many undistorted images, a few pixels larger, beside
    these.
    """
    moved(("images", "dense/0/images"))(folder)
    shutil.copytree(folder / "sparse/0", folder / "dense/0/sparse")
    for file in (folder / "sparse/0").glob("cameras.*"):
        file.write_bytes(
            file.read_bytes().replace((48).to_bytes(8, "little"), (44).to_bytes(8, "little"))
        )


def undistorted(folder):
    moved(("sparse/0", "dense/0/sparse"))(folder)
    shutil.copytree(folder / "images", folder / "dense/0/images")
    images(lambda image: image.resize((44, 42)))(folder)


def cut_out(folder):
    """Turn images into cut-outs; some of them keep a mask as well."""
    for file in sorted((folder / "images").iterdir()):
        mask = folder / f"masks/{file.name}.png"
        image = Image.open(file).convert("RGB")
        image.putalpha(Image.open(mask).convert("L"))
        image.save(file)
        if int(file.stem) % 3:
            mask.unlink()


def one_opaque(folder):
    for file in sorted((folder / "images").iterdir()):
        image = Image.open(file).convert("RGB")
        if file.stem != "000003":
            image.putalpha(Image.open(folder / f"masks/{file.name}.png").convert("L"))
        image.save(file)
    shutil.rmtree(folder / "masks")


def empty_mask(folder):
    file = folder / "masks/000003.png.png"
    Image.open(file).point(lambda _: 0).save(file)


def far_off(i, matrix):
    return [[*row[:3], row[3] + 1e6] if i == 3 and row is matrix[0] else row for row in matrix]


def two_cameras(folder):
    def split(i, frame):
        for key, place in (("file_path", "images"), ("mask_path", "masks")):
            old = folder / frame[key]
            new = folder / place / "ab"[i % 2] / f"{i // 2}.png"
            new.parent.mkdir(exist_ok=True)
            old.rename(new)
            frame[key] = new.relative_to(folder).as_posix()
        del frame["mask_path"]

    frames(folder, split)
    without_lists(folder)


def without_lists(folder):
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    file.write_text(json.dumps({k: v for k, v in data.items() if not k.endswith("filenames")}))


def without_masks_named(folder):
    frames(folder, lambda _, frame: frame.pop("mask_path"))


def renamed(change):
    """A function that names the images and their paths in transforms.json: change(i) is (path,
    name).
    """

    def rename(folder):
        for i, file in enumerate(sorted((folder / "images").iterdir())):
            file.rename(file.with_name(change(i)[1]))
        frames(folder, lambda i, frame: frame.update(file_path=change(i)[0]))
        without_lists(folder)

    return rename


def accent(i):
    name = f"th\u00e9_{i:02d}.png"
    return unicodedata.normalize("NFC", f"images/{name}"), unicodedata.normalize("NFD", name)


def code_page(folder):
    """A model with names in the code page of a Chinese Windows, while its images have names in
    UTF-8.
    """
    file = folder / "sparse/0/images.bin"
    for image in sorted((folder / "images").iterdir()):
        name = f"\u7167{image.name[2:]}"
        file.write_bytes(file.read_bytes().replace(image.name.encode(), name.encode("gbk")))
        (folder / f"masks/{image.name}.png").rename(folder / f"masks/{name}.png")
        image.rename(image.with_name(name))


def of_sdfstudio(folder):
    data = json.loads((folder / "transforms.json").read_text())
    own = []
    for frame in data["frames"]:
        lens = [[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]]
        pose = (np.array(frame["transform_matrix"]) @ GL_FROM_CV).tolist()
        image, mask = frame["file_path"], frame["mask_path"]
        keys = {"rgb_path": image, "foreground_mask": mask, "camtoworld": pose, "intrinsics": lens}
        own.append(keys)
    size = {"width": data["frames"][0]["w"], "height": data["frames"][0]["h"]}
    (folder / "meta_data.json").write_text(json.dumps(size | {"frames": own}))
    (folder / "transforms.json").unlink()


def listed_twice(folder):
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    data["frames"].append(data["frames"][3] | {"id": 99})
    file.write_text(json.dumps(data))


def with_commas(folder):
    for file in (folder / "pose").iterdir():
        file.write_text(file.read_text().replace(".", ","))


# {report: (format, function of the folder, part of the message)}
TRAINS = {
    "an accent in another form": ("nerfstudio", renamed(accent), ""),
    "paths from where a tool was run": (
        "nerfstudio",
        frame_by_frame("file_path", lambda i, path: f"..\\work/{path}"),
        "",
    ),
    "names in a code page": ("colmap", code_page, ""),
    "a model deeper than usual": ("colmap", moved(("sparse/0", "out/sfm/sparse/0")), ""),
    "images in a folder of their own": (
        "colmap",
        moved(("images", "mapping"), ("sparse/0", "sfm_loops")),
        "",
    ),
    "Plenoxels' folders": ("nsvf", moved(("rgb", "images")), ""),
    "sdfstudio": ("nerfstudio", of_sdfstudio, ""),
    "a frame listed twice": ("nerfstudio", listed_twice, ""),
    "matrices by column": (
        "nerfstudio",
        frame_by_frame("transform_matrix", lambda i, m: np.transpose(m).tolist()),
        "column by column",
    ),
    "decimal commas": ("nsvf", with_commas, ""),
    "labels": (
        "colmap",
        images(lambda mask: mask.point(lambda v: v // 85), names="masks"),
        "label",
    ),
    "a workspace of COLMAP": (
        "colmap",
        workspace,
        "of 2 models, the largest with images next to it is read",
    ),
    "undistorted images beside photographs": ("colmap", undistorted, ""),
    "cut-outs, masks for some": ("colmap", cut_out, ""),
    "folders of another case": ("colmap", moved(("images", "Images"), ("masks", "Masks")), ""),
    "transform.json": ("nerfstudio", moved(("transforms.json", "transform.json")), ""),
    "two cameras, equal names": ("nerfstudio", two_cameras, "masks are taken from"),
    "turned by EXIF, which the program had done": ("nerfstudio", images(turned, ".jpg"), ""),
    "TIFF, BMP, AVIF and inks": ("nerfstudio", several_kinds, ""),
    "masks that no frame names": ("nerfstudio", without_masks_named, "masks are taken from"),
    "masks that no frame names, images with a useless alpha": (
        "nerfstudio",
        lambda folder: [
            without_masks_named(folder),
            images(lambda image: image.convert("RGBA"))(folder),
        ],
        "masks are taken from",
    ),
    "one opaque image among cut-outs": (
        "colmap",
        one_opaque,
        "except for a rim (images/000003.png)",
    ),
    "an empty mask": ("colmap", empty_mask, "1 of 12 views left out: an empty mask"),
    "a pose that is far off": (
        "nerfstudio",
        frame_by_frame("transform_matrix", far_off),
        "left out of the training: images/000003.png",
    ),
}


def train(folder, out):
    sets = set_words(SETTINGS, train__iterations=3)
    return spoken(["train", folder, "--out", out, *sets])


@pytest.mark.parametrize("report", TRAINS)
def test_it_trains_and_says_what_was_done(tmp_path, report):
    form, change, message = TRAINS[report]
    change(a_ball(tmp_path / "scene", form))
    status, lines = train(tmp_path / "scene", tmp_path / "run")
    messages = [line for line in lines if line.startswith("pp-cl: ")]
    assert status == 0, lines
    assert len(messages) == bool(message) and message in "".join(messages), messages
    header, _ = load_checkpoint(tmp_path / "run/checkpoint.npz")
    assert len(header.get("notes", [])) == ("train: " in "".join(messages))
    assert len(header["views"]) == VIEWS - 2 - sum(
        "views left out" in line for line in messages
    ) * (2 if "2 of" in "".join(messages) else 1)


def test_a_test_split_of_which_no_image_has_a_mask_is_listed(tmp_path):
    folder = a_ball(tmp_path / "scene", "colmap")
    gone("masks/000000.png.png", "masks/000008.png.png")(folder)
    assert [file.mask for file in list_split(folder, "test").image_files] == [None, None]


def test_a_test_view_of_another_place_is_not_measured(tmp_path):
    folder = write_ball_scene(tmp_path / "ball", views=12)
    file = tmp_path / "ball/transforms_train.json"
    data = json.loads(file.read_text())
    data["frames"] = data["frames"][::3]
    data["frames"][2]["transform_matrix"][0][3] += 1e6
    (tmp_path / "ball/transforms_test.json").write_text(json.dumps(data))
    assert train(folder, tmp_path / "run")[0] == 0
    status, lines = spoken(["eval", tmp_path / "run"])
    message = "test: 1 of 4 views left out: their masks miss the model (train/r_6.png)"
    assert status == 0 and any(message in line for line in lines), lines
    measured = json.loads((tmp_path / "run/eval/metrics.json").read_text())["per_image"]
    assert [row["name"] for row in measured] == ["train/r_0.png", "train/r_3.png", "train/r_9.png"]


def test_figures_of_a_scene_count_no_view_that_is_left_out(dev, tmp_path):
    change = frame_by_frame("transform_matrix", far_off)
    change(a_ball(tmp_path / "scene", "nerfstudio"))
    facts, *_ = describe_scene(dev, str(tmp_path / "scene"), "tiny")
    assert len(facts["masks"]["left_out"]) == 1 and max(facts["distances"]) < 10
