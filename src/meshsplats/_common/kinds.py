"""Checks of the kinds of arguments: the errors say what must be, what was given, and what to do."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

T = TypeVar("T")

_MAKES = {
    "GaussianCloud": "load_gaussians reads one from a file, gaussians_from_tensors takes a trained model",
    "SplatMesh": "convert makes one from splats, load_mesh reads one from a file",
    "Camera": "orbit, dome and look_at place cameras, load_cameras reads them",
    "Dataset": "load_dataset reads photographs, splat_dataset makes images of splats",
    "SplatStream": "stream_gaussians opens splat files",
    "BaseMesh": "load_base reads one from a file",
    "MeshPrior": "bind makes one of a base mesh, load_prior reads one",
    "Tileset": "Tileset(folder) opens one, build_tiles makes it",
    "View": "a Dataset has them, dataset.train",
    "ConversionOptions": "single options go by name, convert(cloud, sides=6)",
    "FinetuneConfig": "single settings go by name, finetune(mesh, dataset, minutes=5); make_config makes one",
    "TrainConfig": "single settings go by name, train(dataset, minutes=5); train_config makes one",
    "SurfaceOptions": "single options go by name, make_surface(scene, faces=5000)",
    "RunOptions": "RunOptions(folder='run')",
    "TileOptions": "TileOptions(max_triangles=65536)",
    "PageOptions": "PageOptions(title='A scene')",
    "Workers": "open_workers opens them",
    "ScenePoints": "load_points reads them from a data set",
    "str": "names are in quotes",
    "path": "a str or a pathlib.Path names a file",
    "array": "np.asarray makes one",
}
"""Where an object of a kind comes from."""
_INSTEAD = {
    ("GaussianCloud", "path"): "load_gaussians(path) reads splats",
    ("SplatMesh", "path"): "load_mesh(path) reads a mesh, convert(load_gaussians(path)) makes one of splats",
    ("Camera", "path"): "load_cameras(path) reads cameras",
    ("Dataset", "path"): "load_dataset(path) reads one",
    ("SplatStream", "path"): "stream_gaussians(path) opens it",
    ("BaseMesh", "path"): "load_base(path) reads one",
    ("MeshPrior", "path"): "load_prior(path) reads one",
    ("Tileset", "path"): "Tileset(path) opens it",
    ("View", "path"): "load_dataset(path).train reads views",
    ("ScenePoints", "path"): "load_points(path) reads them",
    ("SplatMesh", "GaussianCloud"): "convert(cloud) makes a mesh of it",
    ("GaussianCloud", "SplatMesh"): "a mesh does not become splats again: give those that it was made from",
    ("SplatMesh", "MeshPrior"): "prior.mesh is its mesh",
    ("SplatMesh", "Tileset"): "render_tiles draws tilesets, tiles_mesh makes a mesh of one for given cameras",
    ("SplatMesh", "BaseMesh"): "bind(base) lays splats on it",
    ("BaseMesh", "SplatMesh"): "load_base(path) reads a classical mesh",
    ("MeshPrior", "SplatMesh"): "MeshPrior(mesh) takes a mesh that keeps its binding",
    ("MeshPrior", "BaseMesh"): "bind(base) makes a prior of it",
    ("GaussianCloud", "SplatStream"): "load_gaussians reads all splats, convert_blocks takes a stream",
    ("SplatStream", "GaussianCloud"): "save_gaussians writes it to a file, stream_gaussians opens that",
    ("Dataset", "GaussianCloud"): "splat_dataset(cloud) makes images of it",
    ("Dataset", "SplatMesh"): "splat_dataset(cloud) makes images of the splats that it was made from",
    ("Camera", "Dataset"): "[view.camera for view in dataset.views] are its cameras",
    ("Camera", "View"): "view.camera is its camera",
    ("View", "Dataset"): "dataset.train are its views",
    ("path", "GaussianCloud"): "it is loaded already; save_gaussians writes it",
    ("path", "SplatMesh"): "it is loaded already; save_mesh writes it",
    ("path", "Dataset"): "it is loaded already",
    ("array", "Rendering"): "rendering.color is the image",
    ("array", "ViewImage"): "view.over(background) is the image",
    ("array", "path"): "read the image first, with Pillow say: np.asarray(Image.open(path)) / 255",
    ("GaussianCloud", "dict"): "gaussians_from_tensors takes the tensors of a trained model",
}
"""By the wanted kind and the given one: how to get the former."""


def need(
    kind: type, *, optional: bool = False, instead: Mapping[str, str] | None = None, **given: object
) -> None:
    """TypeError unless the arguments ``given`` are of a ``kind``.

    Args:
        kind: the class.
        optional: None will do, too.
        instead: what to do, by the name of the kind that was given.
        given: the arguments by name.
    """
    for name, value in given.items():
        if not (optional and value is None):
            require(kind, name, value, instead)


def require(kind: type, name: str, value: object, instead: Mapping[str, str] | None = None) -> None:
    """``need`` for one argument, or a part of one, by its ``name``."""
    if not isinstance(value, kind):
        raise TypeError(_message(name, _with_article(kind.__name__), kind.__name__, value, instead or {}))


def need_all(
    kind: type, *, optional: bool = False, instead: Mapping[str, str] | None = None, **given: object
) -> None:
    """TypeError unless the arguments ``given`` are sequences of a ``kind``, such as lists."""
    for name, value in given.items():
        if optional and value is None:
            continue
        wanted = f"a list of {kind.__name__}"
        if isinstance(value, kind):
            raise TypeError(f"{name} must be {wanted}, got {described(value)}: give [{name}] or more of them")
        if isinstance(value, (str, bytes, Mapping)) or not isinstance(value, Sequence):
            raise TypeError(_message(name, wanted, kind.__name__, value, instead or {}))
        for i, part in enumerate(value):
            require(kind, f"{name}[{i}]", part)


def each(kind: type[T], name: str, value: Iterable[T], *, again: bool = False) -> Iterable[T]:
    """``value``, an iterable of a ``kind``, with its parts checked as they come. TypeError, at once or then,
    for anything else. ``again``: it must be possible to iterate over it several times."""
    wanted = f"an iterable of {kind.__name__}"
    if isinstance(value, kind):
        raise TypeError(f"{name} must be {wanted}, got {described(value)}: give [{name}] or more of them")
    if isinstance(value, (str, bytes, os.PathLike, Mapping)) or not isinstance(value, Iterable):
        raise TypeError(_message(name, wanted, kind.__name__, value, {}))
    if again and isinstance(value, Iterator):
        raise TypeError(
            f"{name} must be {wanted} that can be iterated over several times, got {described(value)}:"
            f" list({name}) makes one"
        )
    return _Checked(kind, name, value) if again else iter(_Checked(kind, name, value))


class _Checked(Iterable[T]):
    def __init__(self, kind: type[T], name: str, parts: Iterable[T]) -> None:
        self._kind, self._name, self._parts = kind, name, parts

    def __iter__(self) -> Iterator[T]:
        for i, part in enumerate(self._parts):
            require(self._kind, f"{self._name}[{i}]", part)
            yield part


def need_path(*, instead: Mapping[str, str] | None = None, **given: object) -> None:
    """TypeError unless the arguments ``given`` name files or folders."""
    for name, value in given.items():
        require_path(name, value, instead)


def require_path(name: str, value: object, instead: Mapping[str, str] | None = None) -> None:
    """``need_path`` for one argument, or a part of one, by its ``name``."""
    if not isinstance(value, (str, os.PathLike)):
        raise TypeError(_message(name, "a path", "path", value, instead or {}))


def need_choice(words: object, *, optional: bool = False, **given: object) -> None:
    """ValueError unless the arguments ``given`` are among the ``words``, a ``Literal``.

    Args:
        words: the type.
        optional: None will do, too.
        given: the arguments by name.
    """
    for name, value in given.items():
        if value not in get_args(words) and not (optional and value is None):
            raise ValueError(f"{name} must be one of {', '.join(get_args(words))}, got {value!r}")


def as_path(name: str, value: object) -> Path:
    """The path that the argument ``name`` gives; TypeError for what names no file or folder."""
    require_path(name, value)
    return Path(value)  # type: ignore[arg-type]


def need_array(
    *, wanted: str = "an array of numbers", instead: Mapping[str, str] | None = None, **given: object
) -> None:
    """TypeError unless the arguments ``given`` are arrays of numbers, or become such as lists do."""
    for name, value in given.items():
        try:
            array = None if isinstance(value, (str, bytes, os.PathLike)) else np.asarray(value)
        except (TypeError, ValueError, RuntimeError):  # ragged lists; tensors with gradients, or on a GPU
            array = None
        if array is None or array.dtype.kind not in "fiub":
            raise TypeError(_message(name, wanted, "array", value, instead or {}))


def need_numbers(**given: object) -> None:
    """TypeError unless the arguments ``given`` are numbers."""
    for name, value in given.items():
        _number(name, value, "a number")


def as_whole(name: str, value: object) -> int:
    """The whole number that the argument ``name`` gives. TypeError for what is no number, ValueError for a
    fraction."""
    number = _number(name, value, "a whole number")
    if not number.is_integer():
        raise ValueError(f"{name} must be a whole number, got {value}")
    return int(number)


def _number(name: str, value: Any, wanted: str) -> float:
    is_text = isinstance(value, (str, bytes))  # which may read as a number
    with suppress(TypeError, ValueError):
        if not is_text:
            return float(value)
    maker = "int" if "whole" in wanted else "float"
    todo = f"{maker}({name}) makes one of digits" if is_text else f"give one, {name}=20 say"
    raise TypeError(f"{name} must be {wanted}, got {described(value)}: {todo}")


def described(value: object) -> str:
    """``value`` in a message: its kind, and what distinguishes it."""
    kind = kind_of(value)
    if value is None or isinstance(value, (bool, int, float, complex, np.generic)):
        return repr(value) if value is None else f"{value!r}, {_with_article(type(value).__name__)}"
    if kind == "path":
        text = repr(os.fspath(value))  # type: ignore[call-overload]
        return f"the {'text' if isinstance(value, str) else 'path'} {text[:60]}{'...' * (len(text) > 60)}"
    if isinstance(value, type):
        return f"the class {value.__name__}, not an object of it"
    if kind in ("ndarray", "Tensor"):
        shape = tuple(getattr(value, "shape", ()))
        return f"a {'NumPy array' if kind == 'ndarray' else 'torch.Tensor'} of shape {shape}"
    if isinstance(value, Mapping):
        keys = ", ".join(str(key)[:20] for key in list(value)[:4])
        return f"a {type(value).__name__} with {keys or 'nothing'}{', ...' * (len(value) > 4)}"
    if isinstance(value, (list, tuple)):
        inner = {kind_of(part) for part in value}
        of = inner.pop() if len(inner) == 1 else "objects"
        return (
            f"a {type(value).__name__} of {len(value)} {of}" if value else f"an empty {type(value).__name__}"
        )
    if callable(value) and hasattr(value, "__name__"):
        return f"the function {value.__name__}"
    return _with_article(type(value).__name__)


def kind_of(value: object) -> str:
    """Name of the kind of ``value``: that of its class, or 'path', 'dict' and 'list' for all such classes."""
    if isinstance(value, (str, os.PathLike)):
        return "path"
    if isinstance(value, Mapping):
        return "dict"
    if isinstance(value, (list, tuple)):
        return "list"
    for base in type(value).__mro__:
        if base.__module__.partition(".")[0] == "torch" and base.__name__ == "Tensor":
            return "Tensor"
    return type(value).__name__


def _message(name: str, wanted: str, kind: str, value: object, instead: Mapping[str, str]) -> str:
    given = kind_of(value)
    todo = instead.get(given) or _INSTEAD.get((kind, given)) or _of_parts(name, kind, value)
    return f"{name} must be {wanted}, got {described(value)}: {todo or _MAKES.get(kind, f'see help({kind})')}"


def _of_parts(name: str, kind: str, value: object) -> str:
    """What to do with a list that holds the wanted kind, and with tensors."""
    if isinstance(value, (list, tuple)) and value and kind_of(value[0]) == kind:
        return f"give one of them, {name}[0], or call this for each"
    if kind_of(value) == "Tensor" and kind == "array":
        return f"{name}.detach().cpu().numpy() makes one"
    if isinstance(value, Iterable) and not isinstance(value, Sequence) and kind_of(value) == "generator":
        return f"list({name}) makes a list of it"
    return ""


def _with_article(name: str) -> str:
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"
