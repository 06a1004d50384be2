"""The server as tabs talk to it, without a browser."""

import asyncio
import contextlib
import json
import os
import threading

import aiohttp
import pytest
from aiohttp import WSServerHandshakeError
from support.scenes import ring_cameras
from support.viewing import SECONDS, Client, asking, served

from pp_cl.errors import UserError

CAMERA = ring_cameras(1, 48)[0]

HEADERS = {
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}


async def until(condition):
    """Wait until condition() holds."""
    for _ in range(SECONDS * 50):
        if condition():
            return
        await asyncio.sleep(0.02)
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


def test_a_wrong_token_is_refused_and_a_proxy_let_in(dev, trained):
    """JupyterHub's, whose Host and Origin are its own."""
    proxy = {"Host": "hub.example", "Origin": "https://hub.example"}

    async def scenario():
        async with served(dev, trained) as here:
            token, get = here.access.token, here.session.get
            async with get(here.access.address, headers=proxy) as response:
                assert response.status == 200
                assert HEADERS.items() <= dict(response.headers).items()
            for path in ("/", "/socket", "/page.js", f"/{token[:-1]}/", f"/{token}x/page.js"):
                async with get(here.origin + path) as response:
                    assert response.status == 403
            with pytest.raises(WSServerHandshakeError) as caught:
                await here.session.ws_connect(
                    f"{here.origin}/wrong/socket", headers={"Origin": here.origin}
                )
            assert caught.value.status == 403

    asyncio.run(scenario())


def test_bad_requests_are_one_line_and_the_tab_goes_on(dev, trained):
    async def scenario():
        async with served(dev, trained) as here, here.tab() as socket:
            tab = await here.ready(socket)
            camera = tab.last["surroundings"]["camera"]
            for text in (json.dumps(asking(camera | {"cx": float("nan")})), "{"):
                await socket.send_str(text)
                line = (await tab.receive("refused"))["line"]
                assert line and "\n" not in line and "Traceback" not in line
            await socket.send_bytes(b"\x00")
            assert "text" in (await tab.receive("refused"))["line"]
            facts, image = await tab.ask(camera, number=77)
            assert image.shape == (24, 24, 3) and facts["number"] == 77
            snapshot, _ = await tab.ask(camera, kind="snapshot")
            assert snapshot["mime"] == "image/png" and facts["mime"] == "image/jpeg"

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


class GatedRun:
    """Stands in for a LiveRun: draws a request each time the gate is opened."""

    def __init__(self, live):
        self.folder, self.gate, self.begun = live.folder, threading.Semaphore(0), []

    def refresh(self):
        return False

    def new_rows(self):
        return None

    def facts(self):
        return {}

    def draw(self, request):
        self.begun.append(request.number)
        assert self.gate.acquire(timeout=SECONDS)
        if request.show == "error":
            raise UserError("no training views")
        if request.show == "hits":
            raise ZeroDivisionError
        return {"type": request.kind, "number": request.number}, b""


@contextlib.asynccontextmanager
async def gated(dev, trained):
    """(Served, GatedRun, Client of a tab whose first request is in work)."""
    async with served(dev, trained, GatedRun) as here, here.tab() as socket:
        run, tab = here.server.live, Client(socket)
        await send(tab, 1)
        await until(lambda: run.begun == [1])
        yield here, run, tab


async def send(tab, number, **changes):
    await tab.socket.send_str(json.dumps(asking(CAMERA, number=number, **changes)))


def asked(here):
    """The numbers of the requests that wait."""
    return [request.number for request in here.server._asked.values()]


async def numbers(run, tab, count):
    """Of the next pictures."""
    found = []
    for _ in range(count):
        run.gate.release()
        facts, _ = await tab.receive("frame snapshot")
        found.append(facts["number"])
    return found


def test_the_newest_request_of_each_kind_is_answered(dev, trained):
    async def scenario():
        async with gated(dev, trained) as (here, run, tab):
            for number in (2, 3, 4):
                await send(tab, number)
            await send(tab, 5, kind="snapshot")
            await until(lambda: len(here.server._asked) == 2)
            assert await numbers(run, tab, 3) == [1, 4, 5] and here.server.drawn == 3

    asyncio.run(scenario())


def test_tabs_take_turns_and_nothing_is_drawn_for_a_closed_one(dev, trained):
    async def scenario():
        async with gated(dev, trained) as (here, run, tab), here.tab() as socket:
            other = Client(socket)
            async with here.tab() as closed:
                for one, number in ((tab, 2), (Client(closed), 3), (other, 9), (tab, 4)):
                    await send(one, number)
                    await until(
                        lambda n=number: n in (r.number for r in here.server._asked.values())
                    )
            await until(lambda: len(here.server.tabs) == 2)
            assert await numbers(run, tab, 2) == [1, 4] and await numbers(run, other, 1) == [9]
            assert run.begun == [1, 4, 9]

    asyncio.run(scenario())


def test_a_picture_that_cannot_be_had_is_a_line_and_a_bug_ends_the_server(dev, trained):
    async def scenario():
        async with gated(dev, trained) as (_, run, tab):
            await send(tab, 2, show="error")
            assert await numbers(run, tab, 1) == [1]
            run.gate.release()
            assert (await tab.receive("refused"))["line"] == "no training views"
            await send(tab, 3, show="hits")
            run.gate.release()
            await until(lambda: len(run.begun) == 3)

    with pytest.raises(ZeroDivisionError):
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
            tab = Client(socket)
            assert "waiting" in (await tab.receive("facts"))["waiting"]
            assert [row[0] for row in (await tab.receive("log"))["rows"]] == [5]
            with (copied / "log.jsonl").open("ab") as file:
                file.write(lines[1][9:] + lines[2])
            assert [row[0] for row in (await tab.receive("log"))["rows"]] == [5, 10, 15]
            (copied / "new.npz").write_bytes(whole)
            (copied / "new.npz").replace(copied / "checkpoint.npz")
            camera = (await tab.receive("surroundings"))["camera"]
            assert tab.last["facts"]["loads"] == 1 and tab.last["facts"]["waiting"] is None
            await tab.ask(camera)
            async with here.tab() as second:  # knows the same
                assert len((await Client(second).receive("log"))["rows"]) == 3
            (copied / "log.jsonl").unlink()
            (copied / "log.jsonl").write_bytes(lines[0])  # a training that begins anew
            assert [row[0] for row in (await tab.receive("log"))["rows"]] == [5]
            os.utime(copied / "checkpoint.npz", ns=(1, 1))
            while tab.last["facts"]["loads"] < 2:
                await tab.receive("facts")

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
