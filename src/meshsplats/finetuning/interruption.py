"""SIGINT, SIGTERM, and SIGHUP, as where a terminal is closed, or SIGBREAK of Windows (Ctrl-Break) stop a run
after the current step."""

from __future__ import annotations

import signal
import threading
from types import TracebackType

_OF_SYSTEM = [getattr(signal, name) for name in ("SIGHUP", "SIGBREAK") if hasattr(signal, name)]
"""Of POSIX, of Windows."""


class Interrupted(KeyboardInterrupt):
    """A signal stopped a run, after it saved a checkpoint.

    Attributes:
        step: number of steps taken.
        signal: number of the signal.
    """

    def __init__(self, step: int, number: int) -> None:
        super().__init__(f"stopped after step {step}")
        self.step, self.signal = step, number

    def __reduce__(self) -> tuple[type[Interrupted], tuple[int, int]]:
        return type(self), (self.step, self.signal)  # BaseException keeps the message alone


class StopSignals:
    """Context manager that stores the first SIGINT, SIGTERM, SIGHUP or SIGBREAK in ``received`` instead of
    ending the process. SIGHUP stays ignored where it is (nohup), and signals stay with the handler of a
    program around Python, such as Blender.

    A second SIGINT raises KeyboardInterrupt at once. Outside the main thread, where Python handles no
    signals, it has no effect.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, object] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            heeded = [number for number in _OF_SYSTEM if signal.getsignal(number) != signal.SIG_IGN]
            for number in (signal.SIGINT, signal.SIGTERM, *heeded):
                if signal.getsignal(number) is not None:  # else it could not be put back
                    self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _handle(self, number: int, frame: object) -> None:
        if self.received is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.received = number
