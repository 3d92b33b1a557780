"""Tasks: one after the other in this process, side by side on this machine, or on a Dask cluster.

Work that splits (cells, images, scenes) hands its tasks to ``Workers``. Dask sends them, starts lost workers
again and repeats their tasks. A result does not depend on where its task ran.
"""

from __future__ import annotations

import importlib
import os
import secrets
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any, Generic, TypeVar

from meshsplats import __version__
from meshsplats._core.library import processors
from meshsplats.errors import ClusterError, DataWarning, MissingDependencyError

Task = TypeVar("Task")
Result = TypeVar("Result")
T = TypeVar("T")
_Warning = tuple[type[Warning], str]
"""Category and message."""
LOCAL = "local"
"""Address of the processors of this machine."""
WAITING = 2
"""Tasks for each thread of a cluster that are sent ahead, so that no worker waits and few results lie
around."""
ANY_PORT = "127.0.0.1:0"
"""For pages about a local cluster, which nobody else should see."""
SECONDS = 30
"""Time for a scheduler to answer."""


class Workers:
    """Runs tasks one after the other in this process.

    Attributes:
        threads: maximum number of threads of a task; None: all processors.
    """

    def __init__(self, threads: int | None = None) -> None:
        self.threads = threads

    def __repr__(self) -> str:
        return "this process"

    def run(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """``function`` of each of the ``tasks``: its index and the result, in the order in which they end.

        On a cluster, function, tasks and results are sent between processes, and a task of a lost worker runs
        again: files that it writes must be whole or missing, and the same each time.

        Raises:
            ClusterError: no worker survives a task, one has another version of MeshSplats, or the scheduler
                is lost.
            Exception: that of a task.
        """
        for i, task in enumerate(tasks):
            yield i, function(task)


@dataclass(frozen=True)
class Shared(Generic[T]):
    """An object that all tasks of a run need: each process makes it once, when a task first needs it.

    So nothing large is sent, and a worker that is started again has it, too.
    """

    make: Callable[[], T]
    token: str = field(default_factory=lambda: secrets.token_hex(16))

    def get(self) -> T:
        """The object of this process. Only the latest one is kept."""
        with _lock:
            return _made[self.token] if self.token in _made else self.hold(self.make())

    def hold(self, made: T) -> T:
        """Makes ``made``, which is at hand, the object of this process, and returns it."""
        with _lock:
            _made.clear()
            _made[self.token] = made
            return made


_made: dict[str, Any] = {}
_lock = threading.RLock()


def memory_of_task() -> int | None:
    """Bytes that a task may use by the limit of its Dask worker; None outside of one, or without a limit."""
    dask = sys.modules.get("distributed")  # which workers have loaded
    if dask is None:
        return None
    try:
        worker = dask.get_worker()
    except ValueError:
        return None
    limit = worker.memory_manager.memory_limit
    return None if limit is None else int(limit) // int(worker.state.nthreads)


@contextmanager
def open_workers(address: str | None, threads: int | None = None) -> Iterator[Workers]:
    """The workers at ``address``, for the length of the block.

    Args:
        address: None: this process. 'local': processes on this machine, as many as keep its processors busy.
            Otherwise the address of a Dask scheduler, such as tcp://host:8786. Its workers take as many tasks
            at a time as they have threads by Dask's count.
        threads: maximum number of threads of a task. By default, all processors for this process, and 1 on a
            cluster.

    Raises:
        MissingDependencyError: Dask is not installed.
        ValueError: not an address.
        OSError: no scheduler answers.
    """
    try:
        if address is None:
            yield Workers(threads)
            return
        if address != LOCAL and "://" not in address:
            raise ValueError(
                "the cluster must be 'local' or the address of a Dask scheduler, such as tcp://host:8786,"
                f" got {address!r}"
            )
        dask = _dask()
        each = threads or 1
        with ExitStack() as stack:
            if address == LOCAL:
                count = max(1, processors() // each)
                stack.enter_context(_importing_safely())
                local = dask.LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=ANY_PORT)
                client = stack.enter_context(dask.Client(stack.enter_context(local)))
            else:
                client = stack.enter_context(dask.Client(address, timeout=SECONDS))
            yield _DaskWorkers(client, each)
    finally:
        with _lock:
            _made.clear()


@contextmanager
def _importing_safely() -> Iterator[None]:
    """Within the block, new processes of Python 3.11 and later import nothing from the current folder, which
    may be a stranger's."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


def _dask() -> Any:
    try:
        return importlib.import_module("distributed")
    except ModuleNotFoundError:
        raise MissingDependencyError(
            'a cluster needs Dask: pip install "meshsplats[cluster]" (or: pip install distributed)'
        ) from None


class _DaskWorkers(Workers):
    """Runs tasks on the workers of a Dask scheduler."""

    def __init__(self, client: Any, threads: int) -> None:
        super().__init__(threads)
        self._client = client

    def __repr__(self) -> str:
        count = len(self._client.nthreads())
        return f"{count} worker{'' if count == 1 else 's'} of {self._client.scheduler.address}"

    def run(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        dask = _dask()
        left = iter(enumerate(tasks))
        indices: dict[Any, int] = {}

        def sent(most: int) -> Iterator[Any]:
            for i, task in islice(left, most):
                future = self._client.submit(partial(_sent, __version__, function), task, pure=False)
                indices[future] = i
                yield future

        running = dask.as_completed(sent(self._room(0)))
        try:
            for future in running:
                result, found = future.result()
                yield indices.pop(future), result
                for category, text in found:
                    warnings.warn(text, category, stacklevel=2)
                for new in sent(self._room(len(indices))):
                    running.add(new)
        except dask.KilledWorker as error:
            raise ClusterError(
                "a task killed one worker after another, perhaps by running out of memory: give each worker"
                f" more memory, or make the tasks smaller ({error})"
            ) from None
        except dask.CancelledError as error:
            raise ClusterError(f"the scheduler was lost: {error}") from None
        finally:
            with suppress(OSError, dask.CancelledError):  # without a scheduler there is nothing to cancel
                self._client.cancel(list(indices), asynchronous=False)

    def _room(self, running: int) -> int:
        """How many more tasks to send, so that the workers have enough."""
        try:
            threads = sum(self._client.nthreads().values())
        except OSError as error:
            raise ClusterError(f"the scheduler was lost: {error}") from None
        return max(0, max(1, WAITING * threads) - running)


def _sent(version: str, function: Callable[[Task], Result], task: Task) -> tuple[Result, list[_Warning]]:
    """``_with_warnings`` in a worker, which must have the ``version`` of MeshSplats of whoever sent it."""
    if version != __version__:
        raise ClusterError(
            f"a worker has MeshSplats {__version__}, this command is of {version}: results of both would be"
            " mixed; install the same version everywhere"
        )
    return _with_warnings(function, task)


def _with_warnings(function: Callable[[Task], Result], task: Task) -> tuple[Result, list[_Warning]]:
    """The result of a task, and the warnings that its user should see."""
    with _task_warnings.collected() as found:
        result = function(task)
    return result, found


class _TaskWarnings:
    """Collects the DataWarnings of tasks in the threads of this process. Others are shown as ever.

    Filters of warnings, and what shows them, belong to the process, so tasks that overlap share one change of
    them.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._found: dict[int, list[_Warning]] = {}
        self._before: warnings.catch_warnings[None] | None = None

    @contextmanager
    def collected(self) -> Iterator[list[_Warning]]:
        """The list of the warnings of this thread, while the block runs."""
        here = threading.get_ident()
        with self._lock:
            if self._before is None:
                self._before = warnings.catch_warnings()
                self._before.__enter__()
                warnings.simplefilter("always", DataWarning)
                warnings.showwarning = partial(self._show, warnings.showwarning)
            found = self._found[here] = []
        try:
            yield found
        finally:
            with self._lock:
                del self._found[here]
                if not self._found:
                    self._before.__exit__(None, None, None)
                    self._before = None

    def _show(
        self,
        show: Callable[..., None],
        message: Warning | str,
        category: type[Warning],
        *where: Any,
        **more: Any,
    ) -> None:
        with self._lock:
            # A thread that a task has started has no list: without knowing whose it is, one task reports it.
            found = self._found.get(threading.get_ident(), next(iter(self._found.values()), None))
            if found is not None and issubclass(category, DataWarning):
                found.append((category, str(message)))
                return
        show(message, category, *where, **more)


_task_warnings = _TaskWarnings()
