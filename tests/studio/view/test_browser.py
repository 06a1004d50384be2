from urllib.parse import urlsplit

import numpy as np
from support.browser import new_page
from support.viewing import drawing, wait

from pp_cl.files.run_folder import RunFolder
from pp_studio.view.run_view import RunView

MIDDLE, ASIDE = (330, 310), (600, 560)  # places in the rendering; the window has 1000 x 700


def shown(page, accept):
    wait(lambda: accept(page.screenshot()))


def test_a_browser_shows_the_model_and_asks_nobody_else(served, dev, trained):
    server, address = served
    view = RunView(server, dev, RunFolder(trained))
    view.look()

    def colours(image):
        return tuple(image[y, x].astype(int) for x, y in (MIDDLE, ASIDE))

    def is_colour(image):
        middle, around = colours(image)
        return (around > 235).all() and (middle < 240).any()

    def is_alpha(image):
        middle, around = colours(image)
        return (around < 60).all() and np.ptp(middle) < 40 and middle.min() > 60

    with drawing(view.page), new_page(address) as page:
        shown(page, is_colour)
        assert page.evaluate("document.title") == "test"
        page.key("2")
        shown(page, is_alpha)
        page.key("1")
        shown(page, is_colour)
        [tab] = view.page._tabs.values()
        eye = tab.camera.eye
        page.drag(MIDDLE, [(9, 4)] * 10)
        shown(page, lambda _: (tab.camera.eye != eye).any())
        assert np.isclose(np.linalg.norm(tab.camera.eye), np.linalg.norm(eye), rtol=0.05)
        hosts = {urlsplit(a).netloc for a in page.asked if a.startswith(("http", "ws"))}
        assert hosts == {urlsplit(address).netloc} and not page.wrong
