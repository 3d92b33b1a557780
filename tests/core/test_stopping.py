"""Ctrl-C during a long call of the core."""

from __future__ import annotations

import _thread
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from _rendering import assert_same_bits, camera, layers

from meshsplats._core import library, stopping
from meshsplats._core.neighbours import nearest
from meshsplats.rendering import render
from meshsplats.rendering.backward import TapedRendering, TapeOptions

posix = pytest.mark.skipif(sys.platform == "win32", reason="processes of Windows get no signals")

LONG = layers(np.linspace(1, 2, 10_000), 0.0005)
VIEW = camera(400, 300)
"""An image of them takes minutes."""
SHORT = camera(45, 40)


@contextmanager
def signals(*numbers):
    """Sends this process the signals, one every 0.2 s."""

    def send():
        for number in numbers:
            time.sleep(0.2)
            os.kill(os.getpid(), number)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield
    finally:
        sender.join()


@pytest.fixture(autouse=True)
def _handlers():
    """Python's own, whatever the tests run in; and they are put back."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@posix
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize(
    "call",
    [
        lambda threads: render(LONG, VIEW, samples=4, threads=threads),
        lambda threads: TapedRendering(
            LONG.triangles, VIEW.with_near_plane(LONG.vertices), TapeOptions(samples=4), threads=threads
        ),
        lambda threads: nearest(np.random.default_rng(0).normal(size=(400_000, 3)), 200, threads=threads),
    ],
)
def test_a_long_call_ends_soon_after(call, threads):
    start = time.perf_counter()
    with signals(signal.SIGINT), pytest.raises(KeyboardInterrupt):
        call(threads)
    assert time.perf_counter() - start < 20
    assert render(LONG, SHORT, threads=threads).fragments  # the core is as good as before


@posix
def test_what_answers_the_signal_decides(monkeypatch):
    """As a run does, which goes on to the end of its step; the image has the same bits."""
    monkeypatch.setattr(library, "QUICK_FRAGMENTS", 0)
    heard = []

    def handler(number, frame):
        heard.append(number)
        if len(heard) == 2:
            raise ValueError("the second one")

    signal.signal(signal.SIGTERM, handler)
    start = time.perf_counter()
    while time.perf_counter() - start < 0.4:  # so that at least one lasts as long as the signal needs
        expected = render(LONG, SHORT)
    with signals(signal.SIGTERM):
        while not heard:
            assert_same_bits(render(LONG, SHORT), expected)
    with signals(signal.SIGTERM), pytest.raises(ValueError, match="the second one"):
        render(LONG, VIEW, samples=4)
    assert heard == [signal.SIGTERM] * 2


@posix
def test_calls_of_other_threads_go_on(monkeypatch):
    monkeypatch.setattr(library, "QUICK_FRAGMENTS", 0)
    expected, images = render(LONG, SHORT), []

    def work():
        images.extend(render(LONG, SHORT) for _ in range(5))

    beside = threading.Thread(target=work)
    beside.start()
    with signals(signal.SIGINT), pytest.raises(KeyboardInterrupt):
        render(LONG, VIEW, samples=4)
    beside.join()
    assert len(images) == 5
    for image in images:
        assert_same_bits(image, expected)


def test_a_call_that_gets_no_thread_is_made_all_the_same(monkeypatch):
    monkeypatch.setattr(library, "QUICK_FRAGMENTS", 0)
    expected = render(LONG, SHORT)

    def refused(function, arguments):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(_thread, "start_new_thread", refused)
    assert_same_bits(render(LONG, SHORT), expected)


@posix
def test_what_answers_a_signal_before_the_call_begins_is_no_missing_thread(monkeypatch):
    def answer(number, frame):
        raise RuntimeError("enough")

    signal.signal(signal.SIGTERM, answer)
    monkeypatch.setattr(_thread, "start_new_thread", lambda function, arguments: 1)  # not yet
    with signals(signal.SIGTERM), pytest.raises(RuntimeError, match="enough"):
        stopping.stoppable(library.load_core(), lambda: pytest.fail("the call is made"))


@posix
def test_a_second_signal_does_not_leave_the_call_behind():
    """Which still writes to its arrays."""
    done = []

    def call():
        time.sleep(0.8)
        done.append(True)
        return 0

    with pytest.raises(KeyboardInterrupt), signals(signal.SIGINT, signal.SIGINT):
        stopping.stoppable(library.load_core(), call)
    assert done


AT_THE_END = """
import builtins
import sys
from meshsplats._core import library, stopping

class Late:
    def __init__(self):
        self.ends, self.stoppable, self.core = sys.is_finalizing, stopping.stoppable, library.load_core()

    def __del__(self):
        print(self.ends(), self.stoppable(self.core, lambda: 7), flush=True)

builtins.late = Late()
"""


def test_what_is_called_while_python_ends_does_not_wait_forever():
    """For a thread that does not begin any more."""
    done = subprocess.run([sys.executable, "-c", AT_THE_END], capture_output=True, text=True, timeout=60)
    assert done.stdout == "True 7\n", done.stderr


def test_errors_of_a_call_are_its_own():
    def fails():
        raise MemoryError("none")

    with pytest.raises(MemoryError, match="none"):
        stopping.stoppable(library.load_core(), fails)
