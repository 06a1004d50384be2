"""The pages in a real browser, headless; skipped where there is no Chromium."""

import asyncio
from urllib.parse import urlsplit

import numpy as np
import pytest
from support.browser import find_chromium, new_page
from support.viewing import drawing

from pp_cl.files.run_folder import RunFolder
from pp_studio.view.run_view import RunView

MIDDLE, ASIDE = (330, 310), (600, 560)  # of the rendering, in a window of 1000 x 700


@pytest.fixture(autouse=True)
def _browser():
    find_chromium()


async def seen(page, accept):
    """(H, W, 3) of the window once it is accepted."""
    for _ in range(60):
        image = await page.screenshot()
        if accept(image):
            return image
        await asyncio.sleep(0.5)
    raise AssertionError(f"never; the console says {page.said}")


def test_a_browser_shows_the_model_and_asks_nobody_else(served, dev, trained):
    server, address = served
    view = RunView(server, dev, RunFolder(trained))
    view.look()

    def colours(image):
        """Of the ball in the middle and of what is around it."""
        return tuple(image[y, x].astype(int) for x, y in (MIDDLE, ASIDE))

    def is_colour(image):
        middle, around = colours(image)
        return (around > 235).all() and (middle < 240).any()

    def is_alpha(image):
        """Grey, on a black ground."""
        middle, around = colours(image)
        return (around < 60).all() and np.ptp(middle) < 40 and middle.min() > 60

    async def scenario():
        async with new_page() as page:
            await page.open(address)
            await seen(page, is_colour)
            await page.key("2")
            await seen(page, is_alpha)
            await page.key("1")
            await seen(page, is_colour)
            [tab] = view.page._tabs.values()
            eye = tab.camera.eye
            await page.drag(MIDDLE, [(9, 4)] * 10)
            await seen(page, lambda _: (tab.camera.eye != eye).any())
            assert np.isclose(np.linalg.norm(tab.camera.eye), np.linalg.norm(eye), rtol=0.05)
            hosts = {urlsplit(a).netloc for a in page.asked if a.startswith(("http", "ws"))}
            assert hosts == {urlsplit(address).netloc}
            assert not [line for line in page.said if line.startswith("error")]

    with drawing(view.page):
        asyncio.run(scenario())
