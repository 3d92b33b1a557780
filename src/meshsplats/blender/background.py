"""A call beside what its thread does."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Background(Generic[T]):
    """A call that runs in a thread of its own from now on.

    Nobody has to wait for it: after Ctrl-C, or where its result is not wanted any more, it ends by itself or
    with the process. Executors wait for theirs.
    """

    def __init__(self, call: Callable[[], T]) -> None:
        self._results: list[T] = []
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(call,), daemon=True)
        self._thread.start()

    def _run(self, call: Callable[[], T]) -> None:
        try:
            self._results.append(call())
        except BaseException as error:  # result() raises it
            self._error = error

    def result(self) -> T:
        """What the call returns, when it has; raises what it raises."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._results[0]
