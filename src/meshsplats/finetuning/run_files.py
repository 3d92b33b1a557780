"""The files of a run: its result, the records beside that, and the folder from which it is resumed."""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from meshsplats._files.locks import locked
from meshsplats.formats.outputs import CONFIGURATION, PREVIEW, beside, check_outputs

if TYPE_CHECKING:
    from meshsplats.finetuning.checkpoint import Checkpoint


@dataclass(frozen=True)
class RunFiles:
    """The files of a run. ``mesh`` is the result; with ``in_cells``, of a run in cells."""

    mesh: Path
    in_cells: bool = False

    @property
    def config(self) -> Path:
        return beside(self.mesh, CONFIGURATION)

    @property
    def preview(self) -> Path:
        return beside(self.mesh, PREVIEW)

    @property
    def folder(self) -> Path:
        """Metrics, previews and the checkpoint."""
        return beside(self.mesh, "run")

    @property
    def command(self) -> Path:
        """The configuration, from the start of the run."""
        return self.folder / "command.toml"

    @property
    def held_out(self) -> Path:
        """Cameras of held-out images of splats."""
        return self.folder / "held_out.cameras.json"

    def earlier(self) -> Checkpoint | None:
        """Of a run that is to be resumed, the checkpoint without its arrays; None for one in cells, which
        have their own."""
        from meshsplats.finetuning.checkpoint import load_checkpoint
        from meshsplats.finetuning.journal import CHECKPOINT

        return None if self.in_cells else load_checkpoint(self.folder / CHECKPOINT, only_header=True)

    def check(self, inputs: Sequence[Path], *, resume: bool, force: bool) -> None:
        """OSError if something would be overwritten, cannot be written, or is missing for --resume."""
        from meshsplats.finetuning.journal import CHECKPOINT, RECORD

        checkpoint = self.folder / (RECORD if self.in_cells else CHECKPOINT)
        if resume and not checkpoint.is_file():
            raise FileNotFoundError(f"no checkpoint at {checkpoint}: leave out ``resume`` to start again")
        for left in (self.folder / CHECKPOINT, self.folder / RECORD):
            if left.exists() and not (resume or force):
                raise FileExistsError(
                    f"{left} is left from an earlier run: ``resume`` continues it, ``force`` starts again"
                )
        if resume and self.mesh.exists() and not force:
            raise FileExistsError(
                f"{self.mesh} exists: the run has ended, or there was one before;"
                " ``resume`` and ``force`` continue it and overwrite the mesh"
            )
        check_outputs([self.mesh, self.config, self.preview], force, inputs=inputs)

    @contextmanager
    def claimed(self, inputs: Sequence[Path], *, resume: bool, force: bool) -> Iterator[None]:
        """While the block runs, no other process writes this run. FileExistsError if one does, and the errors
        of ``check``, as one may have ended meanwhile."""
        self.folder.mkdir(exist_ok=True)
        try:
            with locked(self.folder / ".lock") as ours:
                if not ours:
                    raise FileExistsError(
                        errno.EEXIST,
                        "another process is writing this run; give another name for the output",
                        str(self.folder),
                    )
                self.check(inputs, resume=resume, force=force)
                yield
        finally:
            with suppress(OSError):
                self.folder.rmdir()  # where nothing was written
