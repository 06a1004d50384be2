import base64
import json
import re
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.browser import ask, image_of, new_page
from support.scenes import ring_cameras
from support.splats import draw_splats, splats_of

from pp_cl.engine import Specular
from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba, to_8bit
from pp_cl.metrics.psnr_ssim import psnr
from pp_studio.export import QUALITIES, QUICK
from pp_studio.export.gaussians import (
    GAUSSIAN,
    Gaussians,
    check_drawable,
    drawn_by,
    first_gaussians,
    fitted_gaussians,
    window_camera,
)
from pp_studio.export.page import (
    PACKED,
    first_look,
    pack,
    page_text,
    photographed,
    write_gallery,
)


@pytest.fixture(scope="module")
def page(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "view.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(QUALITIES, QUICK, (300, 0.0))  # enough steps to look like the run
        gaussians = fitted_gaussians(run)._replace(specular=None)
        path.write_text(page_text(gaussians, run.cameras("train"), "ball"))
    return path


def element(page, name):
    return re.search(rf'id="{name}">(.*?)</script>', page.read_text("utf-8"), re.DOTALL)[1]


def header_of(page):
    return json.loads(element(page, "header"))


def unpacked(header, rows):
    """(records of GAUSSIAN, the origin of their positions), read from a page's data."""
    table = np.zeros(len(rows), GAUSSIAN)
    table["position"] = header["unit"] * rows["place"].astype(float)
    table["opacity"] = rows["opacity"] / 255
    least, span = header["logarithms"]
    table["deviations"] = np.exp(least + span * rows["deviations"] / 255)
    x, y, z = (rows["turn"].T - 128.0) / 240
    table["turn"] = np.stack([np.sqrt(1 - x * x - y * y - z * z), x, y, z], axis=1)
    low, span = (np.float32(header[name])[:, None] for name in ("low", "span"))
    table["harmonics"] = low + span * rows["colour"].reshape(-1, 9, 3) / np.float32(255)
    return table, np.array(header["origin"])


def predicted(page, camera):
    """(H, W, 3) uint8: the image that the page must draw, computed in float64."""
    header = header_of(page)
    rows = np.frombuffer(base64.b64decode(element(page, "gaussians")), PACKED)
    distance = np.linalg.norm(camera.eye - header["centre"])
    finer = header["pixel"] * camera.fx / distance
    magnified = (finer / np.clip(finer, *header["windows"])) ** 2
    low_pass = header["low_pass"] * magnified
    splats = splats_of(*unpacked(header, rows))
    return to_8bit(draw_splats(splats, camera, low_pass, low_pass + max(0, 1 - magnified) / 12))


def page_camera(camera):
    names = ("fx", "fy", "cx", "cy", "width", "height")
    values = {name: float(getattr(camera, name)) for name in names}
    return json.dumps({"pose": camera.pose.ravel().tolist()} | values)


def test_it_needs_nothing_but_itself(page):
    text = page.read_text("utf-8")
    for word in ("http", "src=", "href", "@import", "url(", "import(", "fetch(", "XMLHttp"):
        assert word not in text.replace(element(page, "gaussians"), "")
    assert not re.search(r"<!-- \w+ -->", text)
    assert text.count("<script") == 3


def test_gaussians_are_kept_to_within_a_step(rng):
    table = np.zeros(500, GAUSSIAN)
    table["position"] = rng.uniform(-1, 3, (500, 3))
    table["opacity"] = rng.uniform(1 / 255, 0.99, 500)
    table["deviations"] = np.exp(rng.uniform(-7, -2, (500, 3)))
    table["turn"] = np.roll(Rotation.random(500, random_state=1).as_quat(), 1, axis=1)
    table["harmonics"] = rng.normal(size=(500, 9, 3))
    rows, about = pack(table)
    assert PACKED.itemsize == 40 == rows.itemsize
    kept, origin = unpacked(about | {"origin": about["corner"]}, rows)
    before, after = splats_of(table, np.zeros(3)), splats_of(kept, origin)
    assert after["positions"] == pytest.approx(before["positions"], abs=0.6 * about["unit"])
    assert after["opacity"] == pytest.approx(before["opacity"], abs=0.6 / 255)
    size = np.linalg.norm(before["covariance"], axis=(1, 2))
    wrong = np.linalg.norm(after["covariance"] - before["covariance"], axis=(1, 2)) / size
    assert np.quantile(wrong, 0.98) < 0.05  # the rest are sizes clipped at the ends
    wrong = np.abs(after["harmonics"] - before["harmonics"])
    assert np.quantile(wrong, 0.98) < 0.6 * max(about["span"]) / 255


def drawn(page, cameras):
    script = f"""return [{",".join(page_camera(camera) for camera in cameras)}].map(
        (camera) => {{ ppcl.setCamera(camera); return ppcl.canvas.toDataURL(); }});"""
    return [image_of(url) for url in ask(page, script)]


def test_a_browser_draws_what_the_run_shows(run, page):
    cameras = run.cameras("test")
    for image, camera in zip(drawn(page, cameras), cameras, strict=True):
        assert psnr(image, to_8bit(run.render(camera).colour)) > 25


def test_a_browser_draws_gaussians_by_their_rules_in_all_sizes(run, page):
    """Smaller windows than the fit's show means of its pixels; larger ones show its finest,
    enlarged.
    """
    [first, *_] = run.cameras("test")
    header = header_of(page)
    assert header["windows"] == [2, 8]
    cameras = [first.resized(*(2 * [round(times * first.width)])) for times in (0.8, 2, 5, 16)]
    for image, camera in zip(drawn(page, cameras), cameras, strict=True):
        assert psnr(image, predicted(page, camera)) > 42


def test_a_browser_adds_the_reflections_that_the_engine_adds(run, page, tmp_path, rng):
    header = header_of(page)
    rows = np.frombuffer(base64.b64decode(element(page, "gaussians")), PACKED)
    table, origin = unpacked(header, rows)
    table["position"] += origin - run.model.grid.centre
    layer = {
        name: rng.normal(size=shape, scale=0.3).astype(dtype)
        for name, (shape, dtype) in Specular.shapes().items()
    }
    plain = Gaussians(table, run.model.grid.centre, header["windows"], header["low_pass"])
    mirror = plain._replace(specular=layer, extent=run.model.extent)
    cameras = run.cameras("test")[:3]
    images = []
    for name, gaussians in (("plain", plain), ("mirror", mirror)):
        path = tmp_path / f"{name}.html"
        path.write_text(page_text(gaussians, run.cameras("train"), name))
        shown = drawn(path, [camera.resized(96, 96) for camera in cameras])
        finer = 96 / cameras[0].width
        for image, camera in zip(shown, cameras, strict=True):
            window = window_camera(camera.resized(96, 96), finer, gaussians)
            wanted = to_8bit(drawn_by(run, gaussians).render(window).colour)
            assert psnr(image, wanted) > 40
        images.append(shown)
    assert psnr(images[0][0], images[1][0]) < 25


def test_before_the_fit_it_shows_the_points(run, tmp_path):
    path = tmp_path / "first.html"
    path.write_text(page_text(first_gaussians(run), run.cameras("train"), "ball"))
    camera = run.cameras("test")[0]
    [image] = drawn(path, [camera])
    assert psnr(image, to_8bit(run.render(camera).colour)) > 22


def test_the_first_look_is_from_where_photographs_were_taken():
    points, centre = np.random.default_rng(0).normal(size=(99, 3)), np.zeros(3)
    for heights, expected in (((3, 3), 3), ((1, 50), 20), ((40, 50), 40)):
        cameras = [seen_from(a, heights[a // 90 % 2]) for a in range(0, 720, 90)]
        eye, up = first_look(points, centre, cameras)
        assert np.degrees(np.arcsin(eye @ up / np.linalg.norm(eye))) == pytest.approx(expected)


def test_the_first_look_shows_the_whole_object(run):
    centre, points = run.ball[0], run.model.positions()
    eye, up = first_look(points, centre, run.cameras("train"))
    camera = looking(eye, centre, up, 40)
    for angle in range(0, 360, 45):
        turn = Rotation.from_rotvec(np.radians(angle) * up).as_matrix()
        x, y, _ = camera.project((points - centre) @ turn.T + centre)
        assert x.min() > 9 and x.max() < 39 and y.min() > 2 and y.max() < 28
    assert max(np.ptp(x) / 30, np.ptp(y) / 30) > 0.6


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
    for file, file_camera in ((page, camera), (other, camera.moved(by))):
        script = f"ppcl.setCamera({page_camera(file_camera)}); return ppcl.canvas.toDataURL();"
        images.append(image_of(ask(file, script)).astype(int))
    assert np.abs(images[0] - images[1]).max() <= 1 and images[0].min() < 200


def test_a_browser_sorts_the_gaussians_from_far_to_near(page):
    script = """const axis = [0.6, 0, 0.8], order = ppcl.sorted(axis);
        return Array.from(order, (i) => 0.6 * ppcl.positions[3 * i]
            + 0.8 * ppcl.positions[3 * i + 2]).concat([order.length, new Set(order).size]);"""
    *depths, count, different = ask(page, script)
    assert count == different == header_of(page)["count"]
    assert np.diff(depths).max() < 1.1 * np.ptp(depths) / 65535


def looking(eye, target, up, fov):
    """The page's camera of 48 x 30 pixels for these parts of its address."""
    focal = 15 / np.tan(np.radians(fov) / 2)
    return Camera.look_at(eye, target, up, fx=focal, width=48, height=30)


def check_address(page, fragment, camera):
    """Check that the page at an address shows a camera's view; returns it as (H, W, 3) uint8."""
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
    assert psnr(shown, predicted(page, camera)) > 40  # closer than a test view, with more edges
    header = header_of(page)
    first = looking(header["eye"], header["centre"], header["up"], header["fov"])
    check_address(page, "#eye=1,2&target=x&up=,,&fov=-3", first)


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


def in_address(effects, name):
    words = re.search(rf"{name}=([^&]+)", effects["address"])[1].split(",")
    return np.array([float(word) for word in words])


def test_mouse_and_keys_move_the_camera(page):
    effects = ask(page, CONTROLS)
    assert len(set(effects["seen"])) == 4 and effects["seen"][0] == effects["seen"][4]
    header = header_of(page)
    eye, target = (in_address(effects, name) for name in ("eye", "target"))
    centre, first = (np.array(header[name]) for name in ("centre", "eye"))
    assert target == pytest.approx(centre, abs=1e-5)
    distances = [np.linalg.norm(at - centre) for at in (eye, first)]
    assert distances[0] == pytest.approx(distances[1], rel=1e-5)
    up = np.array(header["up"])
    turned = [np.cross(up, at - centre) for at in (eye, first)]
    cosine = turned[0] @ turned[1] / np.prod([np.linalg.norm(t) for t in turned])
    assert np.arccos(cosine) == pytest.approx(60 / 200, abs=1e-4)  # 60 pixels, in radians
    # the pointer moved 20 pixels down, so the eye rises by as much
    rise = [np.arcsin((at - centre) @ up / distances[1]) for at in (eye, first)]
    assert rise[0] - rise[1] == pytest.approx(20 / 200, abs=1e-4)


def test_the_eye_does_not_reach_the_target(page):
    """There would be no direction, and so no way back."""
    script = """
        const key = (key, more) => dispatchEvent(new KeyboardEvent("keydown", { key, ...more }));
        for (let i = 0; i < 300; i++) key("+");
        for (let i = 0; i < 300; i++) key("-");
        key("-", { ctrlKey: true });  // the browser's own
        await new Promise((done) => setTimeout(done, 1000));
        return { address: location.hash };"""
    effects, header = ask(page, script), header_of(page)
    distance = np.linalg.norm(in_address(effects, "eye") - in_address(effects, "target"))
    assert distance == pytest.approx(header["nearest"] / 0.9**300, rel=1e-3)


def test_a_context_that_was_lost_comes_back(page):
    script = """
        const gl = ppcl.canvas.getContext("webgl2"), lost = gl.getExtension("WEBGL_lose_context");
        const wait = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));
        const shown = () => { ppcl.show(); return ppcl.canvas.toDataURL(); };
        const before = shown();
        lost.loseContext(); await wait(300);
        const without = shown();
        lost.restoreContext(); await wait(300);
        return { before, without, after: shown() };"""
    effects = ask(page, script)
    assert effects["before"] == effects["after"] != effects["without"]


def test_what_rests_after_a_movement_is_drawn_in_full(page):
    """During a movement, frames may be coarser and sorted in a slightly older order."""
    with new_page(page.as_uri()) as tab:
        first = tab.screenshot()
        tab.drag((300, 300), [(12, 3)] * 10)
        time.sleep(3)
        rested = tab.screenshot()
        tab.evaluate("ppcl.show()")
        time.sleep(1)
        full = tab.screenshot()
        assert not tab.wrong
    assert np.array_equal(rested, full) and np.abs(first - rested.astype(int)).max() > 60


def seen_from(azimuth, elevation):
    """A camera at these angles, in degrees, that looks at the origin; x is ahead and z is up."""
    a, e = np.radians([azimuth, elevation])
    eye = 4 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    return Camera.look_at(eye, (0, 0, 0), fx=50, width=32, height=32)


def test_a_page_knows_from_where_its_object_was_photographed():
    cameras = [seen_from(*at) for at in ((0, 10), (40, 50), (100, -20))]
    sectors = photographed(cameras, np.zeros(3), np.array([0, 0, 1.0]), np.array([1.0, 0, 0]))
    assert len(sectors) == 36
    assert sectors[0] == [10, 50, 0] and sectors[7] == [-20, 50, 0] and sectors[12] == [-20, -20, 0]
    assert sectors[18] == [-20, -20, 35] and sectors[30] == [10, 10, 15]


def test_beyond_the_photographs_it_fades(run, page):
    header = header_of(page)
    centre, up, ahead = (np.array(header[name]) for name in ("centre", "up", "ahead"))
    script = """for (let i = 0; i < 40; i++) {
            dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowDown" }));
            ppcl.show();
        }
        return ["canvas", "aside"].map(
            (name) => Number(document.querySelector(name).style.opacity));"""
    low, high, aside = header["photographed"][0]
    assert aside == 0 and -80 < low < high < 80
    shown = []
    for elevation in (high, high + 9, high + 20, high + 35):
        e = np.radians(elevation)
        eye = centre + 4 * (np.cos(e) * ahead + np.sin(e) * up)
        fragment = f"#eye={','.join(map(str, eye))}&target={','.join(map(str, centre))}"
        shown.append(
            ask(page, script.partition("return")[1] + script.partition("return")[2], fragment)
        )
    opacities, words = zip(*shown, strict=True)
    assert opacities[:2] == (1, 1) and opacities[3] == 0.1
    assert opacities[2] == pytest.approx(0.55, abs=0.05)
    assert words == (0, 0, pytest.approx(0, abs=0.1), 1)
    assert ask(page, script) == [0.1, 1]  # keys turned the view there


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


def test_its_title_is_text():
    two = np.ones(2, GAUSSIAN)
    two["position"][0] = 0
    cameras = ring_cameras(3, 32)
    text = page_text(Gaussians(two, np.zeros(3), (1, 1), 0), cameras, "<b> & <script>")
    assert "<title>&lt;b&gt; &amp; &lt;script&gt;</title>" in text


@pytest.mark.parametrize("settings", [{"blend": "softmax"}, {"footprint": "disc"}])
def test_runs_that_it_cannot_draw_are_one_line(run, settings):
    raster = replace(run.config.raster, **settings)
    other = replace(run, config=replace(run.config, raster=raster))
    with pytest.raises(UserError, match="config.json: raster.blend .* can only be drawn"):
        check_drawable(other)
