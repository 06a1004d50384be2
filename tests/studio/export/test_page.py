"""The page: what it holds, and what a browser draws of it."""

import base64
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.browser import ask, image_of
from support.models import blend_matrix

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba, to_8bit
from pp_cl.metrics.psnr_ssim import psnr
from pp_cl.run import load_run
from pp_studio.export.harmonics import basis
from pp_studio.export.observe import directions, observe
from pp_studio.export.page import POINT, check_drawable, page_text, write_gallery


@pytest.fixture(scope="module")
def page(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "view.html"
    path.write_text(page_text(run))
    return path


def element(page, name):
    """The content of a script element."""
    return re.search(rf'id="{name}">(.*?)</script>', page.read_text("utf-8"), re.DOTALL)[1]


def content_of(page):
    """(header, rows of POINT, coefficients (N, 9, 3), opacity (N,)) that the page holds."""
    header = json.loads(element(page, "header"))
    rows = np.frombuffer(base64.b64decode(element(page, "points")), POINT)
    values = rows["colour"].reshape(-1, 9, 3) / np.float32(255)
    low, span = (np.float32(header[name])[:, None] for name in ("low", "span"))
    return header, rows, low + span * values, rows["opacity"] / np.float32(65535)


def predicted(run, page, camera):
    """(H, W, 3) uint8: what the page is to draw, by the run's own blend weights."""
    _, _, coefficients, _ = content_of(page)
    positions = run.model.positions()
    at = basis(directions(positions, camera))
    (seen,) = observe(run, [camera], "")
    matrix = blend_matrix(seen)
    image = matrix @ np.einsum("nk,nkc->nc", at, coefficients) + (1 - matrix.sum(1))[:, None]
    return to_8bit(image.reshape(camera.height, camera.width, 3))


def page_camera(camera):
    """The argument of ppcl.setCamera."""
    names = ("fx", "fy", "cx", "cy", "width", "height")
    values = {name: float(getattr(camera, name)) for name in names}
    return json.dumps({"pose": camera.pose.ravel().tolist()} | values)


def test_it_needs_nothing_but_itself(page):
    text = page.read_text("utf-8")
    for word in ("http", "src=", "href", "@import", "url(", "import(", "fetch(", "XMLHttp"):
        assert word not in text.replace(element(page, "points"), "")
    assert not re.search(r"<!-- \w+ -->", text)
    assert text.count("<script") == 3


def test_points_are_kept_to_within_a_step(run, page):
    header, rows, _, opacity = content_of(page)
    places = header["origin"] + header["unit"] * rows["place"].astype(float)
    assert places == pytest.approx(run.model.positions(), abs=0.6 * header["unit"])
    assert header["count"] == len(rows) and header["stride"] == POINT.itemsize == 36
    assert opacity == pytest.approx(run.model.cloud.opacity.get(), abs=0.6 / 65535)
    growth = rows["radius"] / 255 - 0.5
    assert growth == pytest.approx(run.model.cloud.offset.get()[:, 3], abs=0.6 / 255)


def test_what_it_keeps_shows_what_the_run_shows(run, page):
    for camera in run.cameras("test"):
        assert psnr(predicted(run, page, camera), to_8bit(run.render(camera).colour)) > 25


def test_a_browser_draws_what_the_run_shows(run, page):
    cameras = run.cameras("test")
    script = f"""return [{",".join(page_camera(camera) for camera in cameras)}].map(
        (camera) => {{ ppcl.setCamera(camera); return ppcl.canvas.toDataURL(); }});"""
    for url, camera in zip(ask(page, script), cameras, strict=True):
        image = image_of(url)
        assert psnr(image, to_8bit(run.render(camera).colour)) > 25
        assert psnr(image, predicted(run, page, camera)) > 45


def test_a_browser_draws_the_same_far_from_the_origin(run, page, tmp_path):
    by, camera, other = (
        2.0**20 * np.array([1, -1, 1]),
        run.cameras("test")[0],
        tmp_path / "far.html",
    )
    text = element(page, "header")
    header = json.loads(text)
    header |= {name: (header[name] + by).tolist() for name in ("origin", "centre", "eye")}
    other.write_text(page.read_text("utf-8").replace(text, json.dumps(header)))
    images = []
    for file, seen in ((page, camera), (other, camera.moved(by))):
        script = f"ppcl.setCamera({page_camera(seen)}); return ppcl.canvas.toDataURL();"
        images.append(image_of(ask(file, script)).astype(int))
    assert np.abs(images[0] - images[1]).max() <= 1 and images[0].min() < 200


def test_a_browser_sorts_the_points_from_far_to_near(page):
    script = """const eye = [0.3, 4, 1]; ppcl.sortPoints(eye);
        return Array.from(ppcl.order, (i) => Math.hypot(
            ...[0, 1, 2].map((k) => ppcl.positions[3 * i + k] - eye[k]))).concat([ppcl.order.length,
            new Set(ppcl.order).size]);"""
    *distances, count, different = ask(page, script)
    assert count == different == content_of(page)[0]["count"]
    assert np.diff(distances).max() < 1.1 * np.ptp(distances) / 65535


def looking(eye, target, up, fov):
    """The page's camera of 48 x 30 pixels that looks so, as the address says it."""
    focal = 15 / np.tan(np.radians(fov) / 2)
    return Camera.look_at(eye, target, up, fx=focal, width=48, height=30)


def check_address(page, fragment, camera):
    """The page at an address shows what a camera sees; returns that, (H, W, 3) uint8."""
    script = f"""ppcl.show(); const shown = ppcl.canvas.toDataURL();
        ppcl.setCamera({page_camera(camera)}); return [shown, ppcl.canvas.toDataURL()];"""
    urls = ask(page, script, fragment + "&w=48&h=30")
    shown, set_ = (image_of(url) for url in urls)
    assert shown.shape == (30, 48, 3) and shown.min() < 230
    assert psnr(shown, set_) > 50
    return shown


def test_the_address_says_the_camera(run, page):
    camera = looking((1, -3.5, 1.2), (0.1, 0, 0), (0, 0.1, 1), 40)
    fragment = "#eye=1,-3.5,1.2&target=0.1,0,0&up=0,0.1,1&fov=40"
    shown = check_address(page, fragment, camera)
    assert psnr(shown, predicted(run, page, camera)) > 40  # nearer than a test view: more edges


@pytest.mark.parametrize("fragment", ["#eye=1,2&target=x&up=,,&fov=-3", "#eye=1,2,3&target=1,2,3"])
def test_a_broken_address_shows_the_first_look(page, fragment):
    header = content_of(page)[0]
    camera = looking(header["eye"], header["centre"], header["up"], header["fov"])
    check_address(page, fragment, camera)


def test_footprints_are_never_smaller_than_a_pixel(run, page):
    near = run.cameras("test")[0]
    far = replace(near, fx=near.fx / 4, fy=near.fy / 4)
    script = f"ppcl.setCamera({page_camera(far)}); return ppcl.canvas.toDataURL();"
    drawn = image_of(ask(page, script)).astype(int)
    assert np.abs(drawn - predicted(run, page, far)).max() <= 3


CONTROLS = """
    const seen = [], see = () => { ppcl.show(); seen.push(ppcl.canvas.toDataURL()); };
    const send = (type, x, y, more) => ppcl.canvas.dispatchEvent(new PointerEvent(
        type, { pointerId: 1, clientX: x, clientY: y, buttons: 1, bubbles: true, ...more }));
    const drag = (more) => {
        send("pointerdown", 100, 100, more);
        send("pointermove", 160, 120, more);
        send("pointerup", 160, 120, more);
    };
    see();
    drag({}); see();
    const address = location.hash;
    drag({ shiftKey: true }); see();
    ppcl.canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -80 })); see();
    dispatchEvent(new KeyboardEvent("keydown", { key: "r" })); see();
    return { seen, address };"""


def in_address(found, name):
    """(3,) that the address says."""
    words = re.search(rf"{name}=([^&]+)", found["address"])[1].split(",")
    return np.array([float(word) for word in words])


def test_mouse_and_keys_move_the_camera(page):
    found = ask(page, CONTROLS)
    assert len(set(found["seen"])) == 4 and found["seen"][0] == found["seen"][4]
    header = content_of(page)[0]
    eye, target = (in_address(found, name) for name in ("eye", "target"))
    centre, first = (np.array(header[name]) for name in ("centre", "eye"))
    assert target == pytest.approx(centre, abs=1e-5)
    distances = [np.linalg.norm(at - centre) for at in (eye, first)]
    assert distances[0] == pytest.approx(distances[1], rel=1e-5)
    up = np.array(header["up"])
    turned = [np.cross(up, at - centre) for at in (eye, first)]
    cosine = turned[0] @ turned[1] / np.prod([np.linalg.norm(t) for t in turned])
    assert np.arccos(cosine) == pytest.approx(60 / 200, abs=1e-4)  # radians, of 60 pixels
    # the hand moved down, so the eye rises by 20 pixels' worth
    rise = [np.arcsin((at - centre) @ up / distances[1]) for at in (eye, first)]
    assert rise[0] - rise[1] == pytest.approx(20 / 200, abs=1e-4)


def test_a_gallery_is_pages_with_stills_and_an_index(run, tmp_path):
    assert write_gallery(tmp_path / "all", [run, run]) == 2
    names = {path.name for path in (tmp_path / "all").iterdir()}
    assert names == {"index.html", "run.html", "run.png", "run-2.html", "run-2.png"}
    text = (tmp_path / "all" / "index.html").read_text("utf-8")
    linked = re.findall(r'(?:href|src|:image" content)="([^"]+)"', text)
    assert set(linked) == names - {"index.html"}
    for stem in ("run", "run-2"):
        page = (tmp_path / "all" / f"{stem}.html").read_text("utf-8")
        assert f'<meta property="og:image" content="{stem}.png">' in page
        still = read_rgba(tmp_path / "all" / f"{stem}.png")
        assert still.shape[:2] == (315, 600) and still[..., :3].min() < 200
        assert still[:, [0, -1], :3].min() > 200


def test_the_runs_name_is_text(run_folder, session_device, tmp_path):
    folder = tmp_path / "<b> & </script>".replace("/", "")
    shutil.copytree(run_folder, folder)
    text = page_text(load_run(session_device, folder))
    assert "<title>&lt;b&gt; &amp; &lt;script&gt;</title>" in text


@pytest.mark.parametrize("settings", [{"blend": "softmax"}, {"footprint": "disc"}])
def test_runs_that_it_cannot_draw_are_one_line(run, settings):
    raster = replace(run.config.raster, **settings)
    other = replace(run, config=replace(run.config, raster=raster))
    with pytest.raises(UserError, match="config.json: raster.blend .* can only be drawn"):
        check_drawable(other)
