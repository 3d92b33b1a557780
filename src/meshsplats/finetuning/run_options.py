"""Options of a run that do not change its result."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from meshsplats._common.choices import Device
from meshsplats._common.kinds import need_path
from meshsplats._common.options import Range, check_options
from meshsplats.datasets.views import CACHE_BYTES


@dataclass(frozen=True)
class RunOptions:
    """Options that do not change the result, but for rounding: output folder, intervals of logging,
    resources."""

    folder: Path | None = None
    """Folder for checkpoint, metrics, previews and configuration, which no other process may write meanwhile;
    it is made if missing, but not its parent. Files of these names that are not of an earlier run are never
    replaced. None: nothing is written."""
    resume: bool = False
    """Resume from the checkpoint in ``folder``."""
    replace_old: bool = False
    """Begin again where an earlier run left a checkpoint in ``folder``, and remove its files."""
    report_every: Annotated[int, Range(0, math.inf)] = 100
    """Steps between two scores on held-out views. 0: only at the end."""
    preview_every: Annotated[int, Range(0, math.inf)] = 500
    """Steps between two preview images; also one after each quarter of the run. 0: none."""
    checkpoint_seconds: Annotated[float, Range(0, math.inf)] = 30.0
    """Seconds between two checkpoints."""
    threads: Annotated[int | None, Range(1, math.inf)] = None
    """Maximum number of threads. None: all processors."""
    device: Device = "cpu"
    """Where images are rendered, and gradients computed: 'cpu' or 'gpu'. Opacity 'cutoff' needs 'cpu'."""
    spent: Annotated[float, Range(0, math.inf)] = 0.0
    """Seconds already spent. They count towards ``minutes``; the schedule of a training goes by the rest."""
    reserve: Annotated[float, Range(0, math.inf)] = 0.0
    """Seconds that the caller needs afterwards. They count, too."""
    cache_bytes: Annotated[int, Range(0, math.inf)] = CACHE_BYTES
    """Limit of the data set's image cache, for the memory estimate."""

    def __post_init__(self) -> None:
        if self.folder is not None:
            need_path(folder=self.folder)
            object.__setattr__(self, "folder", Path(self.folder))
        check_options(self)
        if self.resume and self.folder is None:
            raise ValueError("resume needs the folder of the run")
