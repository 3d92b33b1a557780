"""Ranks: processes that tune one mesh together, each with its share of a batch of views.

Every rank holds the whole state and takes the same steps. Of a step, it computes the gradients of its own
views; then the ranks exchange the rows of vertices that these views reach, and each adds them up in the order
of the ranks. So all states stay equal to the last bit, and runs with the same number of ranks give the same
bits. ``torchrun`` starts the processes, and torch.distributed (gloo) carries the exchange.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from meshsplats._arrays import nonzero_rows
from meshsplats._core.library import processors
from meshsplats.errors import GET_TORCH, MissingDependencyError

_STARTED = "TORCHELASTIC_RUN_ID"
"""Set by torchrun in each process that it starts."""


class Part(NamedTuple):
    """The findings of a rank in a step."""

    vertices: np.ndarray
    """(v, 3) float32 sum of the gradients of its views."""
    colors: np.ndarray
    """(v, 4) float32."""
    loss: float
    """Sum of the losses of its views."""
    views: int
    """Count of its views with pixels that count."""
    failed: int
    """1 + index of a view without finite loss or gradient; 0 if there is none."""
    window_samples: int = 1 << 62
    """The limit of windows on the GPU after these views (``WindowLimit``)."""


class Ranks:
    """A run in one process.

    Attributes:
        index: of this process, from 0.
        count: of all processes.
    """

    index = 0
    count = 1

    def share(self, batch: int) -> range:
        """The places of a batch, 0 to ``batch`` - 1, whose views this rank computes."""
        return range(self.index * batch // self.count, (self.index + 1) * batch // self.count)

    def total(self, part: Part) -> Part:
        """The sum of the parts of all ranks, in their order. May change the arrays of ``part``."""
        return part

    def any(self, flag: bool) -> bool:
        """Whether ``flag`` is set on any rank."""
        return flag

    def wait(self) -> None:
        """Returns when all ranks have called it."""


ALONE = Ranks()


def is_started_by_torchrun(environment: Mapping[str, str] | None = None) -> bool:
    """Whether this process is one of several that torchrun has started."""
    found = os.environ if environment is None else environment
    return _STARTED in found and int(found.get("WORLD_SIZE", "1")) > 1


def ranks_of_machine() -> int:
    """The number of ranks on this machine; 1 without torchrun."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1")) if is_started_by_torchrun() else 1


@contextmanager
def joined_ranks(threads: int | None = None) -> Iterator[tuple[Ranks, int | None]]:
    """The ranks that torchrun has started, for the length of the block, and the threads of this one: those
    given, else its share of the processors of its machine. ``ALONE`` and ``threads`` without torchrun.

    Raises MissingDependencyError without torch.
    """
    if not is_started_by_torchrun():
        yield ALONE, threads
        return
    try:
        import torch
        import torch.distributed as distributed
    except ImportError:
        raise MissingDependencyError(
            f"ranks need torch: pip install 'meshsplats[torch]' ({GET_TORCH})"
        ) from None
    each = threads or max(1, processors() // ranks_of_machine())
    torch.set_num_threads(each)
    distributed.init_process_group("gloo")
    try:
        yield _TorchRanks(distributed), each
    finally:
        distributed.destroy_process_group()


class _TorchRanks(Ranks):
    """One of several processes."""

    def __init__(self, distributed: Any) -> None:
        self._distributed = distributed
        self.index, self.count = distributed.get_rank(), distributed.get_world_size()
        self._sent, self._received = _Rows(), _Rows()

    def total(self, part: Part) -> Part:
        rows = np.flatnonzero(nonzero_rows(part.colors) | nonzero_rows(part.vertices))
        head = [len(rows), part.loss, part.views, part.failed, part.window_samples]
        heads = self._gather(np.array(head, np.float64))
        own = self._sent.take(len(rows))
        own[0][:] = rows
        vertices, colors = part.vertices, part.colors
        for array, copied in zip((vertices, colors), own[1:], strict=True):
            # Ten times as fast as indexing, without the check of each row.
            np.take(array, rows, axis=0, out=copied, mode="clip")
        if self.index > 1:  # to add to those of the first two, in whatever order, is to add in their order
            vertices, colors = np.zeros_like(vertices), np.zeros_like(colors)
        for sender, (count, *_) in enumerate(heads):
            found = own if sender == self.index else self._received.take(int(count))
            # Several times as fast as gathering, and each sends as many rows as it has.
            for array in found:
                self._distributed.broadcast(_tensor(array), sender)
            if sender == self.index < 2:
                continue
            for array, added in zip((vertices, colors), found[1:], strict=True):
                _add_rows(array, found[0], added)
        loss, views = (float(sum(head[i] for head in heads)) for i in (1, 2))
        failed = next((int(head[3]) for head in heads if head[3]), 0)
        return Part(vertices, colors, loss, int(views), failed, min(int(head[4]) for head in heads))

    def any(self, flag: bool) -> bool:
        return any(found[0] for found in self._gather(np.array([flag], np.int32)))

    def wait(self) -> None:
        self._distributed.barrier()

    def _gather(self, array: np.ndarray) -> Sequence[np.ndarray]:
        """The arrays of all ranks, of one shape, in their order."""
        found = [np.empty_like(array) for _ in range(self.count)]
        self._distributed.all_gather([_tensor(each) for each in found], _tensor(array))
        return found


class _Rows:
    """Memory for rows of gradients, used again in each step."""

    def __init__(self) -> None:
        self._indices, self._values = np.empty(0, np.int32), np.empty(0, np.float32)

    def take(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(count,) int32 indices of vertices, (count, 3) and (count, 4) float32 their gradients."""
        if count > len(self._indices):
            self._indices, self._values = np.empty(count, np.int32), np.empty(7 * count, np.float32)
        vertices, colors = self._values[: 3 * count], self._values[3 * count : 7 * count]
        return self._indices[:count], vertices.reshape(count, 3), colors.reshape(count, 4)


def _tensor(array: np.ndarray) -> Any:
    """``array`` for torch, in the same memory."""
    import torch

    return torch.from_numpy(array)


def _add_rows(array: np.ndarray, rows: np.ndarray, added: np.ndarray) -> None:
    """Adds ``added`` to the ``rows`` of ``array``, which differ."""
    total = np.take(array, rows, axis=0, mode="clip")
    total += added
    whole = np.dtype((np.void, array.itemsize * array.shape[1]))  # a row at a time: twice as fast
    array.view(whole).reshape(-1)[rows] = total.view(whole).reshape(-1)
