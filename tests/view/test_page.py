"""The page in a real browser, headless; skipped where there is no Chromium."""

import asyncio
import json
from urllib.parse import urlsplit

import numpy as np
import pytest
from support.chromium import chromium, find_chromium
from support.viewing import served

SHOWN = ("alpha", "depth", "normals", "hits", "error")
PICTURE = "document.getElementById('picture').toDataURL()"
NUMBER = "Number(document.body.dataset.number || 0)"
MIDDLE = 300, 350  # of the picture in a window of 1000 x 700


@pytest.fixture(autouse=True)
def _browser():
    find_chromium()


async def still(page, act=None):
    """The picture in full resolution after something was done; act: a coroutine that does it."""
    before = 0
    if act is not None:
        before = await page.evaluate(NUMBER)
        await act
    await page.until(f"{NUMBER} > {before} && document.body.dataset.draft == 'false'")
    last = -1
    while last != (last := await page.evaluate(NUMBER)):
        await asyncio.sleep(0.25)  # longer than the page waits for stillness
    return await page.evaluate(PICTURE)


def click(page, what):
    return page.evaluate(f"document.querySelector('{what}').click()")


def set_slider(page, name, value):
    return page.evaluate(
        f"(() => {{ const s = document.getElementById('{name}'); s.value = {value};"
        " s.dispatchEvent(new Event('input')); })()"
    )


def test_switches_sliders_mouse_and_keys_change_the_picture(dev, trained):
    async def scenario():
        async with served(dev, trained) as here, chromium() as browser, browser.page() as page:
            await page.open(here.access.address)
            first = await still(page)
            assert not page.said
            for show in SHOWN:
                assert await still(page, click(page, f"input[value={show}]")) != first
            assert await still(page, click(page, "input[value=colour]")) == first
            for name, value in {"early_stop": 1, "kept": 0.1, "exposure": -2}.items():
                assert await still(page, set_slider(page, name, value)) != first
                assert await still(page, click(page, "#reset")) == first
            for drag in (page.drag(MIDDLE, [(9, 4)] * 8), page.drag(MIDDLE, [(9, 4)] * 8, "right")):
                assert await still(page, drag) != first
                assert await still(page, page.key("r")) == first
            wheel = page.mouse("mouseWheel", *MIDDLE, deltaX=0, deltaY=300)
            assert await still(page, wheel) != first
            assert await still(page, page.key("r")) == first
            assert await still(page, page.key("f")) != first  # the photograph
            assert await page.evaluate("document.body.dataset.show") == "photograph"
            assert await still(page, page.key("f")) == first
            assert not page.said
            hosts = {urlsplit(address).netloc for address in page.asked if address[:5] != "blob:"}
            assert hosts == {f"127.0.0.1:{here.access.port}"} and len(page.asked) >= 6

    asyncio.run(scenario())


def test_a_frustum_is_clicked_the_camera_copied_and_the_device_shown(dev, trained):
    async def scenario():
        async with served(dev, trained) as here, chromium() as browser, browser.page() as page:
            await page.open(here.access.address)
            await still(page)
            for _ in range(3):  # until other views are inside of the picture
                await still(page, page.mouse("mouseWheel", *MIDDLE, deltaX=0, deltaY=400))
            before = await copied_camera(page)
            views = here.server._told["surroundings"]["views"]
            place, name = await place_of_a_frustum(page, {view["name"] for view in views})
            await still(page, page.drag(place, []))
            after = await copied_camera(page)
            assert after != before
            expected = {view["name"]: view["camera"] for view in views}[name]
            np.testing.assert_allclose(after["transform_matrix"], expected["transform_matrix"])
            assert (after["w"], after["fl_x"]) == (expected["w"], expected["fl_x"])
            await click(page, "#device")
            text = await page.until("document.getElementById('numbers').innerText")
            assert dev.name in text and "frames per second" in text

    async def place_of_a_frustum(page, names):
        """Where a frustum is pointed at, and the name of its view, as the caption says it."""
        for x in range(20, 680, 22):
            for y in range(30, 680, 22):
                await page.mouse("mouseMoved", x, y)
                name = await page.evaluate("document.getElementById('caption').textContent")
                if name in names:
                    return (x, y), name
        raise AssertionError("no frustum in the picture")

    asyncio.run(scenario())


def test_dragging_brings_frames_and_a_second_tab_is_another(dev, trained):
    async def scenario():
        async with served(dev, trained) as here, chromium() as browser:
            async with browser.page() as page, browser.page() as other:
                await page.open(here.access.address)
                first = await still(page)
                await other.open(here.access.address)
                second = await still(other)
                assert first == second and len(here.server.tabs) == 2
                frames = int(await page.evaluate("document.body.dataset.frames"))
                await page.call("Page.bringToFront")
                turned = await still(page, page.drag(MIDDLE, [(5, 1)] * 60, pause=0.03))
                assert turned != first
                assert int(await page.evaluate("document.body.dataset.frames")) > frames + 2
                assert await other.evaluate(PICTURE) == second
                assert not page.said and not other.said
            for _ in range(200):
                await asyncio.sleep(0.05)
                if not here.server.tabs:
                    break
            drawn = here.server.drawn
            await asyncio.sleep(0.5)
            assert not here.server.tabs and here.server.drawn == drawn

    asyncio.run(scenario())


def test_fingers_turn_and_pinch_on_a_small_screen(dev, trained):
    async def scenario():
        async with served(dev, trained) as here, chromium() as browser, browser.page() as page:
            size = {"width": 390, "height": 800, "deviceScaleFactor": 2, "mobile": True}
            await page.call("Emulation.setDeviceMetricsOverride", **size)
            await page.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
            await page.open(here.access.address)
            first = await still(page)
            assert await page.evaluate("document.documentElement.scrollWidth") == 390
            path = [(200 + 8 * i, 200) for i in range(9)]
            turned = await still(page, page.touch(path))
            assert turned != first
            apart = [(180 - 8 * i, 200) for i in range(9)], [(220 + 8 * i, 200) for i in range(9)]
            assert await still(page, page.touch(*apart)) not in (first, turned)
            after = await copied_camera(page)
            view = here.server._told["surroundings"]
            away = [np.subtract(eye_of(c), view["centre"]) for c in (after, view["camera"])]
            assert np.linalg.norm(away[0]) < 0.7 * np.linalg.norm(away[1])

    def eye_of(facts):
        return np.array(facts["transform_matrix"])[:3, 3]

    asyncio.run(scenario())


async def copied_camera(page):
    """The camera as the page gives it."""
    await click(page, "#copy")
    return json.loads(await page.until("document.getElementById('camera').value"))


def test_the_page_waits_for_a_checkpoint_and_shows_the_curve(dev, copied):
    whole = (copied / "checkpoint.npz").read_bytes()
    (copied / "checkpoint.npz").unlink()

    async def scenario():
        async with served(dev, copied) as here, chromium() as browser, browser.page() as page:
            await page.open(here.access.address)
            await page.until("document.getElementById('message').innerText.includes('waiting')")
            await page.until("!document.getElementById('training').hidden")
            assert float(await page.evaluate("document.getElementById('last_psnr').innerText")) > 5
            (copied / "checkpoint.npz").write_bytes(whole)
            await still(page)
            turned = await still(page, page.drag(MIDDLE, [(9, 4)] * 8))
            touch = asyncio.to_thread((copied / "checkpoint.npz").touch)
            assert await still(page, touch) == turned  # drawn anew, and the camera has stayed
            assert here.server.live.loads == 2 and not page.said

    asyncio.run(scenario())
