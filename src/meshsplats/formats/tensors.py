"""Splats as the tensors of a training program: before activation, under its names.

Layouts, from the programs' sources:

- gsplat, ``examples/simple_trainer.py`` (github.com/nerfstudio-project/gsplat): a dict of ``means`` (n, 3),
  ``quats`` (n, 4) w x y z of any length, ``scales`` (n, 3) logarithms, ``opacities`` (n,) logits, ``sh0``
  (n, 1, 3), ``shN`` (n, k, 3);
- the 3D Gaussian Splatting code of INRIA, ``scene/gaussian_model.py``
  (github.com/graphdeco-inria/gaussian-splatting): attributes ``_xyz``, ``_rotation``, ``_scaling``,
  ``_opacity`` (n, 1), ``_features_dc`` (n, 1, 3), ``_features_rest`` (n, k, 3) of the same meaning; two
  columns of ``_scaling`` in 2DGS;
- nerfstudio's splatfacto, ``nerfstudio/models/splatfacto.py`` (github.com/nerfstudio-project/nerfstudio): a
  dict ``gauss_params`` as gsplat's, but ``features_dc`` (n, 3), ``features_rest`` (n, k, 3), ``opacities``
  (n, 1). If k = 0, the sigmoid of ``features_dc`` is the colour itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, overload

import numpy as np

from meshsplats._common.arrays import checked_array, subsample
from meshsplats._common.kinds import described, need, need_choice
from meshsplats.errors import GET_TORCH, MissingDependencyError
from meshsplats.formats import _activation
from meshsplats.formats._validation import local_positions
from meshsplats.formats.ply import activated as stored_activated
from meshsplats.formats.ply.activated import Activated
from meshsplats.formats.splats._cloud_builder import CloudBuilder
from meshsplats.scene.gaussians import GaussianCloud, Kernel, constant_harmonics

if TYPE_CHECKING:
    import torch as torch_library

Layout = Literal["gsplat", "inria", "nerfstudio"]


class _Names(NamedTuple):
    means: str
    quaternions: str
    scales: str
    opacities: str
    first: str
    """Spherical harmonics of degree 0..."""
    rest: str
    """... and of all others, which may be missing."""


class _Stored(NamedTuple):
    means: np.ndarray
    quaternions: np.ndarray
    logs: np.ndarray
    """Of two or three scales."""
    logits: np.ndarray
    first: np.ndarray
    rest: np.ndarray


_LAYOUTS: dict[Layout, _Names] = {
    "gsplat": _Names("means", "quats", "scales", "opacities", "sh0", "shN"),
    "inria": _Names("_xyz", "_rotation", "_scaling", "_opacity", "_features_dc", "_features_rest"),
    "nerfstudio": _Names("means", "quats", "scales", "opacities", "features_dc", "features_rest"),
}


def gaussians_from_tensors(
    tensors: Any,
    *,
    kernel: Kernel | None = None,
    strict: bool = False,
    origin: Sequence[float] | np.ndarray | None = None,
    activated: Iterable[Activated] = (),
) -> GaussianCloud:
    """The splats that a training program holds, after activation.

    Takes torch tensors of any type and device, with gradients or without, and NumPy arrays. Their names tell
    the program:

    - gsplat: a dict with ``means``, ``quats``, ``scales`` (logarithms), ``opacities`` (logits), ``sh0`` and
      ``shN``, such as ``splats`` of its trainer, or of a checkpoint, ``torch.load(path)["splats"]``;
    - 'inria', the 3D Gaussian Splatting code: its ``GaussianModel``, or a dict with ``_xyz``, ``_rotation``,
      ``_scaling``, ``_opacity``, ``_features_dc`` and ``_features_rest``;
    - nerfstudio's splatfacto: the ``gauss_params`` of its model.

    Values are rounded to float32 first, positions relative to an origin, which is not zero where float32 is
    too coarse for them. Then, concretely, scales are ``exp(scales)``, opacities ``1 / (1 +
    exp(-opacities))``, quaternions are divided by their lengths, and the harmonics follow each other, as in a
    .ply file of these programs: the cloud is the one that ``load_gaussians`` reads of that, to the last bit.

    Args:
        tensors: a mapping, or an object with attributes of these names.
        kernel: that the splats were trained with; '3dgs' by default, '2dgs' if there are two scales.
            'antialiased' for gsplat's ``rasterize_mode="antialiased"``. Third scales of '2dgs' splats are 0.
        strict: raise an error for unusable splats, where by default a DataWarning says how many are left out:
            those with values that are not finite after activation, or with a zero quaternion.
        origin: as for ``load_gaussians``.
        activated: which of 'scales', 'opacities' and 'colors' are given as they are, such as ``get_scaling``
            and ``get_opacity`` of a ``GaussianModel``. A DataWarning says where values look so.

    Raises:
        TypeError: ``tensors`` is nothing of the kind.
        ValueError: one is missing, its shape is wrong, there are no splats, or an option is out of range.
    """
    done = stored_activated.checked_activated(activated)
    layout, take = _layout(tensors)
    names = _LAYOUTS[layout]
    given = _array(names.means, take(names.means), "(n, 3)", lambda shape: shape[1:] == (3,))
    point = None if origin is None else checked_array("origin", origin, np.float64, (3,))
    means, at = local_positions(given, point, f"the tensors of {layout}")
    means = means.astype(np.float32, copy=False)
    n = len(means)
    if n == 0:
        raise ValueError(f"{names.means!r} holds no splats, its shape is {means.shape}")

    def part(name: str, shape: str, *fits: tuple[int, ...]) -> np.ndarray:
        return _part(name, take(name), shape.replace("(n", f"({n}"), lambda s: s[0] == n and s[1:] in fits)

    quaternions = part(names.quaternions, "(n, 4)", (4,))
    logs = part(names.scales, "(n, 3), or (n, 2) of 2DGS", (3,), (2,))
    logits = part(names.opacities, "(n,) or (n, 1)", (), (1,)).reshape(n)
    first = part(names.first, "(n, 1, 3) or (n, 3)", (1, 3), (3,)).reshape(n, 1, 3)
    rest = first[:, :0]
    if take(names.rest) is not None:
        rest = part(names.rest, "(n, k, 3) with k = 0, 3, 8 or 15", *((k, 3) for k in (0, 3, 8, 15)))
    stored = _Stored(means, quaternions, logs, logits, first, rest)
    looks = {name: span for name, span in _looks_activated(stored).items() if name not in done}
    stored_activated.warn_of(looks, f"the tensors of {layout}", stacklevel=2)
    if "colors" in done:
        stored = stored._replace(first=stored_activated.harmonics_of(first, stored_activated.span_of(first)))
    elif layout == "nerfstudio" and not rest.shape[1]:
        stored = stored._replace(first=constant_harmonics(_activation.activated_opacities(first)))
    return _cloud(stored, kernel, done, f"the tensors of {layout}", at, strict=strict)


def _looks_activated(stored: _Stored) -> dict[Activated, int]:
    """Which of the values look so, by a sample of them, and their greatest value."""
    columns = stored.means, stored.logs, stored.logits, stored.first[:, 0]
    sample = [subsample(column, stored_activated.SAMPLE) for column in columns]
    finite = np.logical_and.reduce([np.isfinite(a.reshape(len(a), -1)).all(axis=1) for a in sample])
    means, scales, opacities, colors = (array[finite] for array in sample)
    return stored_activated.suspects(len(stored.means), means, scales, opacities, colors)


def _cloud(
    stored: _Stored,
    kernel: Kernel | None,
    done: Sequence[Activated],
    where: str,
    origin: np.ndarray,
    *,
    strict: bool,
) -> GaussianCloud:
    """The cloud of ``stored`` values, of which some are activated already; warnings are for the caller's
    caller."""
    means, quaternions, logs, logits, first, rest = stored
    n = len(means)
    builder = CloudBuilder(n, 1 + rest.shape[1], where, origin=origin)
    rows = builder.next(n)
    rows.means[:], rows.quaternions[:] = means, quaternions
    if "opacities" in done:
        rows.opacities[:] = np.clip(logits / np.float32(stored_activated.span_of(logits)), 0, 1)
    else:
        _activation.activated_opacities(logits, out=rows.opacities)
    kernel = kernel or ("2dgs" if logs.shape[1] == 2 else "3dgs")
    axes = 2 if kernel == "2dgs" else logs.shape[1]
    scales = logs[:, :axes]
    if "scales" in done:
        rows.scales[:, :axes] = np.where(scales >= 0, scales, np.nan)  # no deviation is negative
    else:
        rows.scales[:, :axes] = _activation.activated_scales(scales)
    rows.scales[:, axes:] = 0
    rows.sh[:, :1], rows.sh[:, 1:] = first, rest
    builder.keep(rows)
    return builder.finish(kernel, strict=strict)


@overload
def gaussians_to_tensors(
    cloud: GaussianCloud, layout: Layout = "gsplat", *, torch: Literal[False] = False
) -> dict[str, np.ndarray]: ...
@overload
def gaussians_to_tensors(
    cloud: GaussianCloud, layout: Layout = "gsplat", *, torch: Literal[True]
) -> dict[str, torch_library.Tensor]: ...
def gaussians_to_tensors(
    cloud: GaussianCloud, layout: Layout = "gsplat", *, torch: bool = False
) -> dict[str, np.ndarray] | dict[str, torch_library.Tensor]:
    """The splats of ``cloud`` as a training program holds them, before activation.

    The inverse of ``gaussians_from_tensors``, which has the layouts: positions and harmonics come back
    exactly, the others within rounding. Opacities of 0 and 1 and scales of 0, whose logits and logarithms are
    infinite, become sigmoid(-30), sigmoid(20) and 1.2e-38, as in ``save_gaussians``. 'inria' has two scales
    for '2dgs' clouds. 'nerfstudio' keeps colours of degree 0 as logits if there are no others, so they are
    clipped to [0, 1]. Positions are relative to the cloud's ``origin``, which tensors have no place for.

    Args:
        cloud: the splats.
        layout: 'gsplat', 'inria' or 'nerfstudio'.
        torch: give torch tensors, on the CPU and without gradients, in place of NumPy arrays.

    Returns:
        float32 arrays by name, copies of the cloud's.

    Raises:
        ValueError: there is no such layout.
        MissingDependencyError: torch is not installed.
    """
    need(GaussianCloud, cloud=cloud)
    need_choice(Layout, layout=layout)
    names = _LAYOUTS[layout]
    axes = 2 if layout == "inria" and cloud.kernel == "2dgs" and not cloud.scales[:, 2].any() else 3
    opacities = _activation.logits(cloud.opacities)
    first = cloud.sh[:, :1].copy()
    if layout == "nerfstudio":
        first = first[:, 0] if cloud.sh_degree else _activation.logits(cloud.colors)
    arrays = {
        names.means: cloud.means.copy(),
        names.quaternions: cloud.quaternions.copy(),
        names.scales: _activation.log_scales(cloud.scales[:, :axes]),
        names.opacities: opacities if layout == "gsplat" else opacities[:, None],
        names.first: first,
        names.rest: cloud.sh[:, 1:].copy(),
    }
    if not torch:
        return arrays
    try:
        import torch as library
    except ModuleNotFoundError as error:
        raise MissingDependencyError(f"torch tensors need torch; {GET_TORCH}") from error
    return {name: library.from_numpy(array) for name, array in arrays.items()}


def _layout(tensors: Any) -> tuple[Layout, Callable[[str], Any]]:
    """The layout of ``tensors``, and what looks up one of them, None if it is missing."""
    if hasattr(tensors, "keys") and hasattr(tensors, "__getitem__"):  # dicts, and torch's ParameterDict
        held = set(tensors.keys())

        def take(name: str) -> Any:
            return tensors[name] if name in held else None

    else:

        def take(name: str) -> Any:
            return getattr(tensors, name, None)

    best = max(_LAYOUTS, key=lambda layout: sum(take(name) is not None for name in _LAYOUTS[layout]))
    missing = [name for name in _LAYOUTS[best][:-1] if take(name) is None]
    if len(missing) == 5 or isinstance(tensors, GaussianCloud):
        known = "; ".join(f"{', '.join(names)} ({layout})" for layout, names in _LAYOUTS.items())
        raise TypeError(f"tensors must hold those of a program: {known}; got {described(tensors)}")
    if missing:
        listed = ", ".join(map(repr, missing))
        raise ValueError(f"tensors must hold {', '.join(_LAYOUTS[best])}, as {best} does; missing: {listed}")
    return best, take


def _part(name: str, value: Any, shape: str, fits: Callable[[tuple[int, ...]], bool]) -> np.ndarray:
    """A tensor or array as a float32 array, without importing torch."""
    return _array(name, value, shape, fits).astype(np.float32, copy=False)


def _array(name: str, value: Any, shape: str, fits: Callable[[tuple[int, ...]], bool]) -> np.ndarray:
    """A tensor or array as an array of float32, or of another type of NumPy."""
    if hasattr(value, "detach"):
        value = value.detach().cpu()
        doubles = str(getattr(value, "dtype", "")) == "torch.float64"
        value = (value if doubles else value.float()).numpy()  # NumPy does not know bfloat16
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name!r} must hold numbers, got {described(value)}")
    if array.ndim == 0 or not fits(array.shape):
        raise ValueError(f"{name!r} must have shape {shape}, got {array.shape}")
    return array
