"""Long calls of the core, which end when somebody presses Ctrl-C."""

from __future__ import annotations

import _thread
import ctypes
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

PATIENCE = 0.1
"""Seconds after which the main thread looks for signals again. Most of them wake it."""


def stoppable(core: ctypes.CDLL, call: Callable[[], int]) -> int:
    """The status that ``call``, of a function of the ``core``, returns.

    Python answers signals in its main thread alone, and there not before a function of C returns. So another
    thread makes the call while the main thread waits. Where that is ended by the exception of what answers a
    signal, such as KeyboardInterrupt, the call is, too; what it wrote is of no use then.
    """
    if threading.current_thread() is not threading.main_thread() or sys.is_finalizing():
        return call()  # nothing is answered here; or no thread would begin any more
    stop = ctypes.c_int32(0)
    ended = _thread.allocate_lock()
    ended.acquire()
    turns: list[str] = []
    statuses: list[int | BaseException] = []
    helper: int | None = None

    def work() -> None:
        turns.append("call")
        if turns[0] == "call":
            try:
                core.ms_stop_with(ctypes.byref(stop))
                statuses.append(call())
            except BaseException as error:
                statuses.append(error)
        ended.release()

    def wait() -> None:
        while not statuses:
            ended.acquire(timeout=PATIENCE)

    try:
        helper = _thread.start_new_thread(work, ())
        wait()
    except BaseException as error:
        turns.append("stop")
        if turns[0] == "call":
            stop.value = 1
            while not statuses:  # arrays are in use, whatever comes
                with suppress(BaseException):
                    wait()
            raise
        if helper is None and isinstance(error, RuntimeError):  # the system refuses more threads
            return call()
        raise
    status = statuses[0]
    if isinstance(status, BaseException):
        raise status
    return status
