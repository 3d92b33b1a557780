"""Splats of Universal Scene Description: prims of the type ParticleField3DGaussianSplat.

Needs the optional package usd-core, which runs in a process of its own (``splat_extraction``). All visible
fields of a stage are joined, in metres. Colours are display values unless ColorSpaceAPI says that they are
linear: those of converters without a mark are as they were trained.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, BinaryIO

import numpy as np

from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._display import display_cloud, say_converted
from meshsplats.formats._orientation import Y_DOWN_FROM_Z_UP
from meshsplats.formats._validation import Budget
from meshsplats.formats.content import Content
from meshsplats.formats.opened import Splats
from meshsplats.formats.reading import FormatReader, Reading
from meshsplats.formats.splats._cloud_builder import CloudBuilder, joined_within
from meshsplats.formats.usd.crate import holds_token, is_crate
from meshsplats.formats.usd.reader import extracted
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.origin import choose_origin, sampled, zero_origin

_PRIM = b"ParticleField3DGaussianSplat"
_TEXT = 8 << 20
"""Bytes of a text file in which the prim is looked for."""


class _UsdSplats(Splats):
    """The splats of a USD file, which is read as a whole."""

    def __init__(self, content: Content) -> None:
        self._path = content.path
        report, self._arrays = extracted(content.path, "meshsplats.formats.usd.splat_extraction")
        self._fields: list[dict[str, Any]] = report["fields"]
        self.to_y_down = Y_DOWN_FROM_Z_UP if report["z_up"] else None
        for message in report["warnings"]:
            warnings.warn(f"{content.path}: {message}", DataWarning, stacklevel=6)

    def world_sample(self) -> np.ndarray:
        samples = []
        for i, field in enumerate(self._fields):
            matrix = np.array(field["matrix"])
            samples.append(sampled(self._arrays[f"means_{i}"]) @ matrix[:3, :3].T + matrix[:3, 3])
        return np.concatenate(samples)

    def chosen_origin(self) -> np.ndarray:
        if note := self._fields[0]["note"]:
            return np.array(note["origin"])
        return choose_origin(self.world_sample())

    def read(self, *, strict: bool, origin: np.ndarray | None = None) -> GaussianCloud:
        origin = self.chosen_origin() if origin is None else origin
        clouds = []
        for i, field in enumerate(self._fields):
            cloud = self._cloud(i, strict=strict)
            if field["linear"]:
                say_converted(self._path)
                cloud = display_cloud(cloud)
            if note := field["note"]:
                cloud = replace(cloud, kernel=note["kernel"], up=note["up"], origin=np.array(note["origin"]))
                clouds.append(cloud.relative_to(origin))
                continue
            try:
                clouds.append(cloud.transformed(np.array(field["matrix"]), origin=origin))
            except ValueError as error:
                raise FileFormatError(
                    f"{self._path}: a transform cannot be applied to splats: {error}"
                ) from None
        return joined_within(clouds, Budget(self._path))

    def blocks(self, size: int, *, strict: bool, origin: np.ndarray) -> Iterator[GaussianCloud]:
        cloud = self.read(strict=strict, origin=origin)
        for start in range(0, len(cloud), size):
            yield cloud.take(np.arange(start, min(start + size, len(cloud))))

    def _cloud(self, i: int, *, strict: bool) -> GaussianCloud:
        """The splats of a field in its own frame."""
        own = {name: self._arrays[f"{name}_{i}"] for name in ("means", "orientations", "scales", "sh")}
        count = len(own["means"])
        builder = CloudBuilder(count, own["sh"].shape[1], self._path, origin=zero_origin())
        rows = builder.next(count)
        rows.means[:], rows.quaternions[:], rows.sh[:] = own["means"], own["orientations"], own["sh"]
        rows.scales[:] = np.where(own["scales"] < 0, np.nan, own["scales"])  # no deviation is negative
        rows.opacities[:] = np.clip(self._arrays[f"opacities_{i}"][:, 0], 0, 1)
        builder.keep(rows)
        return builder.finish("3dgs", strict=strict)


def _matches(content: Content) -> bool:
    """Whether it is a USD file, or a package, with splats in it; meshes are not of this format."""
    if not content.is_usd:
        return False
    with content.open_usd() as file:
        return _holds_splats(file)


def _holds_splats(file: BinaryIO) -> bool:
    return holds_token(file, _PRIM) if is_crate(file) else _PRIM in file.read(_TEXT)


def _open(content: Content, _file: BinaryIO, _reading: Reading) -> _UsdSplats:
    return _UsdSplats(content)


READER = FormatReader(_matches, _open)
