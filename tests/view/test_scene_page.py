"""The page of a scene: who may change it, and what it writes, also from a real browser."""

import asyncio
import contextlib
import json
import shutil
import socket

import aiohttp
import numpy as np
import pytest
from aiohttp import web
from support.chromium import chromium, find_chromium

from pp_cl.scene.load import scene_frames
from pp_cl.view.access import Access
from pp_cl.view.scene_server import SceneServer, ShownScene


@pytest.fixture
def folder(scene, tmp_path):
    """A copy of the ball with three sparse points."""
    shutil.copytree(scene, tmp_path / "ball")
    model = tmp_path / "ball" / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 48 48 60 60 24 24\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 4 1 a.png\n\n")
    rows = ("1 -.5 -.5 -.5 255 0 0 0.1", "2 .5 .5 .5 0 255 0 0.1", "3 90 0 0 9 9 9 0.1 1 1")
    (model / "points3D.txt").write_text("\n".join(rows))
    return tmp_path / "ball"


@contextlib.asynccontextmanager
async def served(folder):
    """(Access, session) of a scene that is served."""
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as listening:
        access = Access("127.0.0.1", listening.getsockname()[1])
        runner = SceneServer(ShownScene(folder), access).runner()
        await runner.setup()
        try:
            await web.SockSite(runner, listening).start()
            async with aiohttp.ClientSession() as session:
                yield access, session
        finally:
            await runner.cleanup()


def test_who_has_the_token_reads_and_writes(folder):
    async def scenario():
        async with served(folder) as (access, session):
            origin = f"http://127.0.0.1:{access.port}"
            async with session.get(f"{access.address}scene.json") as answer:
                facts = await answer.json()
            assert len(facts["views"]) == 10 and not facts["is_given"]
            np.testing.assert_allclose(facts["box"], [[-0.48] * 3, [0.48] * 3], atol=0.01)
            async with session.get(f"{access.address}photograph/3") as answer:
                assert (await answer.read())[:2] == b"\xff\xd8"  # JPEG
            async with session.get(f"{access.address}photograph/99") as answer:
                assert answer.status == 404
            async with session.get(f"{origin}/wrong/scene.json") as answer:
                assert answer.status == 403
            edits = {"box": [[-1, -1, -1], [1, 1, 2]], "dropped": ["train/r_2.png"]}
            async with session.post(f"{origin}/wrong/edits", json=edits) as answer:
                assert answer.status == 403
            assert not (folder / "pp_cl.json").exists()
            headers = {"Host": "hub.example", "Origin": "https://hub.example"}  # behind a proxy
            names = [view["name"] for view in facts["views"] if view["split"] == "train"]
            wrong = {"box": [[1, 1, 1], [0, 2, 2]]}, {"box": 3}, {"dropped": names}, [], {"x": 1}
            for bad in wrong:
                post = session.post(f"{access.address}edits", json=bad, headers=headers)
                async with post as answer:
                    assert answer.status == 400 and "\n" not in await answer.text()
            async with session.post(f"{access.address}edits", json=edits, headers=headers) as post:
                assert post.status == 204
            assert json.loads((folder / "pp_cl.json").read_text()) == edits
            (folder / "pp_cl.json").write_text('{"dropped": ["train/r_4.png"]}')  # in an editor
            async with session.post(f"{access.address}edits", json={}, headers=headers) as post:
                assert post.status == 400 and "reload the page" in await post.text()
            assert "r_4" in (folder / "pp_cl.json").read_text()
            async with session.get(f"{access.address}scene.json") as answer:
                assert answer.status == 200
            async with session.post(f"{access.address}edits", json={}, headers=headers) as post:
                assert post.status == 204 and not (folder / "pp_cl.json").exists()

    asyncio.run(scenario())


def test_a_side_is_pulled_and_a_view_dropped_in_the_browser(folder):
    find_chromium()

    async def scenario():
        async with served(folder) as (access, _), chromium() as browser, browser.page() as page:
            await page.open(access.address)
            await page.until("document.body.dataset.drawn > 0")
            ink = await page.evaluate(
                "(() => { const c = document.getElementById('picture'); const d ="
                " c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
                " return d.reduce((n, v, i) => n + (i % 4 == 3 && v > 0), 0); })()"
            )
            assert ink > 1000
            place = await place_of_a_dot(page)
            await page.drag(place, [(4, 3)] * 10)
            await page.until("document.body.dataset.saved == 1")
            pulled = json.loads((folder / "pp_cl.json").read_text())["box"]
            assert (np.abs(np.subtract(pulled, [[-0.48] * 3, [0.48] * 3])) > 0.02).sum() == 1
            await page.evaluate(
                "(() => { const s = document.getElementById('views'); s.selectedIndex = 4;"
                " s.dispatchEvent(new Event('change')); })()"
            )
            await page.key("d")
            await page.until("document.body.dataset.saved == 2")
            assert json.loads((folder / "pp_cl.json").read_text())["dropped"] == ["train/r_4.png"]
            assert [one.name for one in scene_frames(folder)].count("train/r_4.png") == 0
            await page.until("document.getElementById('photograph').naturalWidth == 48")
            assert not page.said

    async def place_of_a_dot(page):
        """Where the pointer is over something, but not over a camera."""
        for x in range(200, 500, 10):
            for y in range(200, 500, 10):
                await page.mouse("mouseMoved", x, y)
                if await page.evaluate(
                    "document.getElementById('stage').classList.contains('over')"
                    " && !document.getElementById('caption').textContent"
                ):
                    return x, y
        raise AssertionError("no dot in the picture")

    asyncio.run(scenario())
