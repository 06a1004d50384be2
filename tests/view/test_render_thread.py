"""The thread that draws for all tabs, with a stand-in that draws when it is let."""

import queue
import threading

import pytest

from pp_cl.errors import UserError
from pp_cl.view.messages import Frame, ViewRequest
from pp_cl.view.render_thread import RenderThread

SECONDS = 20


class GatedRun:
    """Draws one request each time `gate` is opened; `begun` counts those begun."""

    def __init__(self):
        self.gate, self.begun = threading.Semaphore(0), threading.Semaphore(0)

    def refresh(self):
        return False

    def draw(self, request):
        self.begun.release()
        assert self.gate.acquire(timeout=SECONDS)
        if request.show == "error":
            raise UserError("no training views")
        if request.show == "hits":
            raise ZeroDivisionError
        return Frame(request.kind, {"number": request.number}, b"")


class Listener:
    """A tab that notes what it gets."""

    def __init__(self):
        self.got, self.told = [], threading.Semaphore(0)

    def deliver(self, frame):
        self.got.append(frame.facts["number"])
        self.told.release()

    def refuse(self, number, line):
        self.got.append(line)
        self.told.release()

    def wait(self):
        assert self.told.acquire(timeout=SECONDS)


def request(number, show="colour", kind="frame"):
    return ViewRequest(number, kind, show, None, False, 0.0, 1.0, 0.0)


@pytest.fixture
def working():
    """(GatedRun, RenderThread, queue of failures)."""
    run, failures = GatedRun(), queue.Queue()
    thread = RenderThread(run, None, failures.put)
    thread.start()
    yield run, thread, failures
    for _ in range(20):
        run.gate.release()
    thread.stop()


def test_the_newest_request_wins(working):
    run, thread, _ = working
    tab = Listener()
    thread.add(tab)
    thread.submit(tab, request(1))
    assert run.begun.acquire(timeout=SECONDS)  # 1 is in work, the others wait
    for number in (2, 3, 4):
        thread.submit(tab, request(number))
    thread.submit(tab, request(5, kind="snapshot"))  # replaces no frame
    for _ in range(3):
        run.gate.release()
        tab.wait()
    assert tab.got == [1, 4, 5]
    assert thread.drawn == 3


def test_tabs_take_turns(working):
    run, thread, _ = working
    tabs = Listener(), Listener()
    for tab in tabs:
        thread.add(tab)
    thread.submit(tabs[0], request(1))
    assert run.begun.acquire(timeout=SECONDS)
    thread.submit(tabs[0], request(2))
    thread.submit(tabs[1], request(9))
    thread.submit(tabs[0], request(3))
    for tab in (tabs[0], tabs[0], tabs[1]):
        run.gate.release()
        tab.wait()
    assert (tabs[0].got, tabs[1].got) == ([1, 3], [9])


def test_nothing_is_drawn_for_a_closed_tab(working):
    run, thread, _ = working
    closed, other = Listener(), Listener()
    thread.add(closed)
    thread.add(other)
    thread.submit(closed, request(1))
    assert run.begun.acquire(timeout=SECONDS)
    thread.submit(closed, request(2))
    thread.forget(closed)
    thread.submit(closed, request(3))
    thread.submit(other, request(4))
    for _ in range(2):
        run.gate.release()
    other.wait()
    assert closed.got == [] and other.got == [4]
    assert thread.drawn == 2  # 1 was in work already


def test_bad_input_is_a_line_and_a_bug_ends_the_thread(working):
    run, thread, failures = working
    tab = Listener()
    thread.add(tab)
    thread.submit(tab, request(1, "error"))
    run.gate.release()
    tab.wait()
    assert tab.got == ["no training views"] and failures.empty()
    thread.submit(tab, request(2, "hits"))
    run.gate.release()
    assert isinstance(failures.get(timeout=SECONDS), ZeroDivisionError)
