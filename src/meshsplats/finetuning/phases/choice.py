"""Which phases a run has."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from meshsplats.finetuning.checkpoint import reading_arrays
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.initial import order_of
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.phases.cutting import Cutting, check_for_cutoff
from meshsplats.finetuning.phases.hybrid import Hybrid
from meshsplats.finetuning.phases.listed import Listed, check_for_file_order
from meshsplats.finetuning.phases.phase import Phase
from meshsplats.finetuning.state import State
from meshsplats.rendering.engine import Engine, Need
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh

PHASE_ARRAYS = ("color_limits", "listing.copies", "listing.starts")
"""Names of the arrays of all phases in a checkpoint (``Phase.arrays``)."""


def check_phases(
    config: FinetuneConfig, mesh: SplatMesh, engine: Engine, frozen: np.ndarray | None = None
) -> None:
    """ValueError if a phase of the run is not for ``mesh``, ``frozen`` vertices or the ``engine``, whose own
    errors are those of ``Engine.check``."""
    needs: tuple[Need, ...] = ("file order",) if config.order == "file" else ()
    if needs:
        engine.check(needs)
        check_for_file_order(mesh, config)
        return
    if not config.cuts:
        engine.check()
        return
    needs = ("cutoff",)
    engine.check(needs)
    check_for_cutoff(mesh, config, frozen)


def first_phase(
    config: FinetuneConfig,
    start: SplatMesh,
    state: State,
    *,
    resumed: float | None = None,
    arrays: Mapping[str, np.ndarray] | None = None,
    listing: DrawOrder | None = None,
) -> Phase:
    """The phase in which a run begins, or goes on.

    Args:
        config: of the run.
        start: the mesh before the first step.
        state: the state now.
        resumed: the fraction at which the run is resumed; None: it begins.
        arrays: of its checkpoint.
        listing: for order 'file', the order in which it begins.

    Raises FileFormatError if these do not fit.
    """
    if config.order == "file":
        if resumed is None:
            assert listing is not None
            return Listed(config, listing)
        with reading_arrays():
            return Listed.resume(config, state, arrays or {})
    if not config.cuts:
        return Blended(config, None if start.face_splat is None else order_of(start, config))
    if state.solid is None:
        return Cutting(config, start, resumed)
    with reading_arrays():
        return Hybrid.resume(config, state, arrays or {})
