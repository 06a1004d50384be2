"""The server as tabs talk to it, without a browser."""

import asyncio
import json
import os

import aiohttp
import numpy as np
import pytest
from aiohttp import WSServerHandshakeError
from support.viewing import SECONDS, asking, served

from pp_cl.view.messages import SHOWN
from pp_cl.view.server import SocketTab

HEADERS = {
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}


async def until(condition):
    """Wait until condition() holds."""
    for _ in range(SECONDS * 20):
        if condition():
            return
        await asyncio.sleep(0.05)
    raise AssertionError("nothing happened")


def test_files_come_with_their_headers_and_nothing_else_does(dev, trained):
    async def scenario():
        async with served(dev, trained) as here:
            get, address = here.session.get, here.access.address
            for name in (
                "",
                "page.js",
                "page.css",
                "camera.js",
                "curve.js",
                "frustums.js",
                "icon.svg",
            ):
                async with get(address + name) as response:
                    assert response.status == 200 and await response.text()
                    check_headers(response)
            for name in ("x", "../setup.cfg", "%2e%2e/x", "page.html/", "socket"):
                async with get(address + name) as response:
                    assert response.status in (400, 403, 404)
                    check_headers(response)
            async with here.session.post(address, data=b"x" * 10**5) as response:
                assert response.status == 405

    def check_headers(response):
        assert HEADERS.items() <= dict(response.headers).items()
        policy = response.headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'self';") and "unsafe" not in policy

    asyncio.run(scenario())


@pytest.mark.parametrize(
    "headers", [{"Host": "evil.example"}, {"Host": "127.0.0.1"}, {"Origin": "http://evil.example"}]
)
def test_a_foreign_host_or_origin_is_refused(dev, trained, headers):
    async def scenario():
        async with served(dev, trained) as here:
            async with here.session.get(here.access.address, headers=headers) as response:
                assert response.status == 403 and HEADERS.items() <= dict(response.headers).items()
            with pytest.raises(WSServerHandshakeError) as caught:
                await here.tab(**headers)
            assert caught.value.status == 403 and not here.server.tabs

    asyncio.run(scenario())


def test_a_missing_or_wrong_token_is_refused(dev, trained):
    async def scenario():
        async with served(dev, trained) as here:
            token = here.access.token
            for path in ("/", "/socket", "/page.js", f"/{token[:-1]}/", f"/{token}x/page.js"):
                async with here.session.get(here.origin + path) as response:
                    assert response.status == 403
            with pytest.raises(WSServerHandshakeError) as caught:
                await here.session.ws_connect(
                    f"{here.origin}/wrong/socket", headers={"Origin": here.origin}
                )
            assert caught.value.status == 403
            async with here.session.get(f"{here.origin}/{token}/") as response:
                assert response.status == 200

    asyncio.run(scenario())


def test_every_switch_and_slider_changes_the_picture(dev, trained):
    async def scenario():
        async with served(dev, trained) as here, here.tab() as socket:
            tab = await here.ready(socket)
            camera = tab.last["surroundings"]["views"][3]["camera"]
            pictures = [(await tab.ask(camera, show=show))[1] for show in SHOWN]
            changes = ({"early_stop": 0.2}, {"kept": 0.2}, {"exposure": 2})
            pictures += [(await tab.ask(camera, **change))[1] for change in changes]
            assert len({picture.tobytes() for picture in pictures}) == len(SHOWN) + len(changes)
            facts, again = await tab.ask(camera, number=77)
            np.testing.assert_array_equal(again, pictures[0])
            assert facts["number"] == 77 and facts["milliseconds"] > 0 and facts["per_second"] > 0
            snapshot, _ = await tab.ask(camera, kind="snapshot")
            assert snapshot["mime"] == "image/png"

    asyncio.run(scenario())


def test_a_camera_of_nan_is_one_line_and_the_tab_goes_on(dev, trained):
    async def scenario():
        async with served(dev, trained) as here, here.tab() as socket:
            tab = await here.ready(socket)
            camera = tab.last["surroundings"]["camera"]
            for text in (
                json.dumps(asking(camera | {"cx": float("nan")})),
                json.dumps(asking(camera | {"transform_matrix": [[None] * 4] * 4})),
                "{",
            ):
                await socket.send_str(text)
                line = (await tab.receive("refused"))["line"]
                assert line and "\n" not in line and "Traceback" not in line
            await socket.send_bytes(b"\x00")
            assert "text" in (await tab.receive("refused"))["line"]
            assert (await tab.ask(camera))[1].shape == (24, 24, 3)

    asyncio.run(scenario())


def test_a_message_that_is_too_long_ends_the_tab_alone(dev, trained):
    async def scenario():
        async with served(dev, trained) as here, here.tab() as socket, here.tab() as other:
            tab, beside = await here.ready(socket), await here.ready(other)
            await socket.send_str(" " * 10_000)
            with pytest.raises(ConnectionError):
                await tab.receive("frame")
            assert socket.close_code == aiohttp.WSCloseCode.MESSAGE_TOO_BIG
            await until(lambda: len(here.server.tabs) == 1)
            await beside.ask(beside.last["surroundings"]["camera"])

    asyncio.run(scenario())


def test_of_many_requests_the_newest_is_answered(dev, trained):
    async def scenario():
        async with served(dev, trained) as here, here.tab() as socket:
            tab = await here.ready(socket)
            camera = tab.last["surroundings"]["camera"]
            drawn = here.server.thread.drawn
            for number in range(1, 201):
                await socket.send_str(json.dumps(asking(camera, number=number)))
            numbers = [(await tab.receive("frame"))[0]["number"]]
            while numbers[-1] < 200:
                numbers.append((await tab.receive("frame"))[0]["number"])
            assert numbers == sorted(numbers) and len(numbers) < 200
            assert here.server.thread.drawn - drawn < 200

    asyncio.run(scenario())


def test_a_closed_tab_stops_its_rendering(dev, trained):
    async def scenario():
        async with served(dev, trained) as here:
            async with here.tab() as socket:
                tab = await here.ready(socket)
                camera = tab.last["surroundings"]["camera"] | {"w": 400, "h": 400}
                await socket.send_str(json.dumps(asking(camera)))
            await until(lambda: not here.server.tabs)
            await asyncio.sleep(0.2)
            drawn = here.server.thread.drawn
            async with here.tab() as socket:  # the thread is free for others
                tab = await here.ready(socket)
                await tab.ask(tab.last["surroundings"]["camera"])
            assert drawn <= here.server.thread.drawn - 1 <= drawn + 1

    asyncio.run(scenario())


def test_there_are_not_more_tabs_than_allowed(dev, trained, monkeypatch):
    monkeypatch.setattr("pp_cl.view.server.MOST_TABS", 1)

    async def scenario():
        async with served(dev, trained) as here, here.tab() as socket:
            await here.ready(socket)
            with pytest.raises(WSServerHandshakeError) as caught:
                await here.tab()
            assert caught.value.status == 503

    asyncio.run(scenario())


def test_a_training_is_followed(dev, copied):
    whole, log = ((copied / name).read_bytes() for name in ("checkpoint.npz", "log.jsonl"))
    (copied / "checkpoint.npz").unlink()
    lines = log.splitlines(keepends=True)
    (copied / "log.jsonl").write_bytes(lines[0] + lines[1][:9])

    async def scenario():
        async with served(dev, copied) as here, here.tab() as socket:
            tab = await here.ready_to_wait(socket)
            assert "waiting" in tab.last["facts"]["waiting"]
            while not tab.last.get("log", {}).get("rows"):
                await tab.receive("log")
            assert [row[0] for row in tab.last["log"]["rows"]] == [5]
            with (copied / "log.jsonl").open("ab") as file:
                file.write(lines[1][9:] + lines[2])
            added = await tab.receive("log")
            assert added["first"] == 1 and [row[0] for row in added["rows"]] == [10, 15]
            (copied / "new.npz").write_bytes(whole)
            (copied / "new.npz").replace(copied / "checkpoint.npz")
            camera = (await tab.receive("surroundings"))["camera"]
            assert tab.last["facts"]["loads"] == 1 and tab.last["facts"]["waiting"] is None
            await tab.ask(camera)
            os.utime(copied / "checkpoint.npz", ns=(1, 1))
            while tab.last["facts"]["loads"] < 2:
                await tab.receive("facts")

    asyncio.run(scenario())


def test_a_tab_gets_each_row_once_and_no_message_without_rows():
    class Log:
        starts, rows = 0, []

    async def scenario():
        tab, log = SocketTab(None), Log()
        tab.tell_log(log)
        assert sent(tab) == []
        log.rows = [[5], [10]]
        tab.tell_log(log)
        tab.tell_log(log)
        log.rows = [[5], [10], [15]]
        tab.tell_log(log)
        assert sent(tab) == [(0, [[5], [10]]), (2, [[15]])]
        log.starts, log.rows = 1, []
        tab.tell_log(log)
        tab.tell_log(log)
        assert sent(tab)[2:] == [(0, [])]  # the page forgets what it had
        log.rows = [[5]]
        tab.tell_log(log)
        assert sent(tab)[2:] == [(0, [[5]])]  # in its place, as it was not sent yet

    def sent(tab):
        messages = [json.loads(text) for text in tab._outbox.values()]
        return [(message["first"], message["rows"]) for message in messages]

    asyncio.run(scenario())


def test_broken_http_is_refused_and_leaves_no_traceback(dev, trained, capsys, caplog):
    async def scenario():
        async with served(dev, trained) as here:
            for junk in (
                b"GET / HTTP/9.9\r\n\r\n",
                b"\x16\x03\x01\r\n\r\n",
                b"GET /" + b"a" * 9999,
            ):
                reader, writer = await asyncio.open_connection("127.0.0.1", here.access.port)
                writer.write(junk)
                assert (await asyncio.wait_for(reader.read(), SECONDS)).startswith(b"HTTP/1.0 400")
                writer.close()
            async with here.tab() as socket:  # is gone without a word
                await here.ready(socket)
                socket._response.connection.transport.abort()
            await until(lambda: not here.server.tabs)
            async with here.tab() as socket:  # is gone before its pings are answered
                await here.ready(socket)
                for _ in range(3000):
                    await socket.ping(b"x" * 100)
                socket._response.connection.transport.abort()
            await until(lambda: not here.server.tabs)

    asyncio.run(scenario())
    assert caplog.text == "" and capsys.readouterr().err == ""
