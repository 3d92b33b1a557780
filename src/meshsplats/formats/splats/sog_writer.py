"""Writes SOG, version 2: a zip archive of meta.json and one lossless WebP for each attribute.

Splats are sorted in space, so that neighbouring pixels are alike. Scales and colours are told by codebooks,
harmonics by a palette, whose size is that of other writers.
"""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.errors import DataWarning, MissingDependencyError
from meshsplats.formats._activation import log_scales
from meshsplats.formats.splats._palette import palette
from meshsplats.formats.splats._quantising import (
    as_bytes,
    codebook,
    nearest_axes,
    nearest_entry,
    sorted_in_space,
)
from meshsplats.formats.writing import FormatWriter, Writing, warn_of_losses
from meshsplats.scene.gaussians import GaussianCloud

_PALETTE = 1 << 16
_COLUMNS = 64
"""Palette entries in each row of their image."""
_MOST_HARMONIC = 1e9
"""Largest harmonic: beyond, squares of distances between them would not be finite in float32."""


def write_sog(cloud: GaussianCloud, path: Path, writing: Writing) -> None:
    """Writes ``cloud``; see ``save_gaussians``. MissingDependencyError for a Pillow without WebP."""
    from PIL import features

    if not features.check("webp"):
        raise MissingDependencyError(f"{writing.where}: this Pillow was built without WebP, which SOG needs")
    warn_of_losses(cloud, writing.where, keeps=("origin", "up", "antialiased", "2dgs"))
    cloud = cloud.take(sorted_in_space(cloud.means))
    images: dict[str, bytes] = {}
    meta = _meta(cloud)
    meta["means"] = _means(cloud, images)
    flat = cloud.kernel == "2dgs"
    quaternions, scales = nearest_axes(cloud.quaternions, cloud.scales, third_stays=flat)
    importance = _importance(cloud)
    weights = np.repeat(importance, 3)
    logs = log_scales(scales)
    book = codebook(logs, weights)
    images["scales.webp"] = _image(nearest_entry(logs, book))
    meta["scales"] = {"codebook": _listed(book), "files": ["scales.webp"]}
    # x, y, z; that w is left out is told by 252 + its index.
    turns = as_bytes(127.5 + 127.5 * np.sqrt(2) * quaternions[:, 1:])
    images["quats.webp"] = _image(turns, np.full(len(turns), 252, np.uint8))
    meta["quats"] = {"files": ["quats.webp"]}
    book = codebook(cloud.sh[:, 0], weights)
    colors = nearest_entry(cloud.sh[:, 0], book)
    images["sh0.webp"] = _image(colors, as_bytes(cloud.opacities * 255))
    meta["sh0"] = {"codebook": _listed(book), "files": ["sh0.webp"]}
    if cloud.sh_degree:
        meta["shN"] = _harmonics(_bounded(cloud, writing.where), importance, images)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, data in (images | {"meta.json": json.dumps(meta, separators=(",", ":")).encode()}).items():
            # A fixed date: the same splats give the same bytes.
            archive.writestr(zipfile.ZipInfo(name), data)


def _meta(cloud: GaussianCloud) -> dict[str, Any]:
    from meshsplats import __version__

    meta: dict[str, Any] = {"version": 2, "asset": {"generator": f"MeshSplats {__version__}"}}
    meta["count"] = len(cloud)
    if cloud.kernel == "antialiased":
        meta["antialias"] = True
    elif cloud.kernel == "2dgs":
        meta["model"] = "2dgs"
    note = {}
    if cloud.up is not None:
        note["up"] = [float(u) for u in cloud.up]
    if cloud.origin.any():
        note["origin"] = cloud.origin.tolist()
    return meta | ({"meshsplats": note} if note else {})


def _means(cloud: GaussianCloud, images: dict[str, bytes]) -> dict[str, Any]:
    """Positions: sign(x) log(1 + |x|) in 16 bits between its extremes, in two images."""
    means = cloud.means.astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    span = np.where(high > low, high - low, 1)
    steps = np.rint((logs - low) / span * 65535).astype(np.uint16)
    images["means_l.webp"] = _image((steps & 255).astype(np.uint8))
    images["means_u.webp"] = _image((steps >> 8).astype(np.uint8))
    return {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}


def _importance(cloud: GaussianCloud) -> np.ndarray:
    """(n,) float32: how much the errors of each splat count, by how large and opaque it is; 1 on average, and
    no splat for nothing."""
    # float64: products of scales that have exploded are beyond float32.
    sizes = np.sort(cloud.scales, axis=1)[:, 1:].astype(np.float64)
    extent = np.sqrt(sizes.prod(axis=1)) * cloud.opacities
    return (np.sqrt(extent / max(float(extent.mean()), 1e-30)) + np.float32(0.1)).astype(np.float32)


def _bounded(cloud: GaussianCloud, where: Path) -> GaussianCloud:
    """``cloud`` with harmonics that a palette can hold; a DataWarning counts splats that had others."""
    beyond = int((np.abs(cloud.sh[:, 1:]) > _MOST_HARMONIC).any(axis=(1, 2)).sum())
    if not beyond:
        return cloud
    message = f"{where}: harmonics of {beyond:,} splats are beyond {_MOST_HARMONIC:g} and were clipped"
    warnings.warn(message, DataWarning, stacklevel=5)
    return replace(
        cloud, sh=np.concatenate([cloud.sh[:, :1], cloud.sh[:, 1:].clip(-_MOST_HARMONIC, _MOST_HARMONIC)], 1)
    )


def _harmonics(cloud: GaussianCloud, importance: np.ndarray, images: dict[str, bytes]) -> dict[str, Any]:
    coefficients = cloud.sh.shape[1] - 1
    rows = cloud.sh[:, 1:].reshape(len(cloud), -1)
    entries, labels = palette(rows, _palette_size(len(cloud)), importance)
    # Alike entries side by side, as far as one number can say: the image of the labels compresses better.
    order = np.argsort(entries @ _main_axis(entries), kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    entries, labels = entries[order], place[labels]
    book = codebook(entries)
    stored = nearest_entry(entries, book).reshape(len(entries), coefficients, 3)
    table = np.zeros((-(-len(stored) // _COLUMNS) * _COLUMNS, coefficients, 4), np.uint8)
    table[..., 3] = 255
    table[: len(stored), :, :3] = stored
    images["shN_centroids.webp"] = _webp(table.reshape(-1, _COLUMNS * coefficients, 4))
    halves = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
    images["shN_labels.webp"] = _image(halves.astype(np.uint8))
    return {
        "count": len(entries),
        "bands": cloud.sh_degree,
        "codebook": _listed(book),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _palette_size(count: int) -> int:
    return min(_PALETTE, max(1024, 1 << (count.bit_length() - 1)))


def _main_axis(rows: np.ndarray) -> np.ndarray:
    """(m,) direction along which ``rows`` (n, m) differ most."""
    centered = rows - rows.mean(axis=0)
    return np.linalg.eigh((centered.T @ centered).astype(np.float64))[1][:, -1].astype(np.float32)


def _image(rgb: np.ndarray, alpha: np.ndarray | None = None) -> bytes:
    """Values (n, 3) of the splats as an image nearly as high as wide, and their alpha (n,), or 255."""
    n = len(rgb)
    width = -(-int(np.ceil(np.sqrt(n))) // 4) * 4
    height = -(-n // width // 4) * 4 or 4
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:n, :3] = rgb
    pixels[:n, 3] = 255 if alpha is None else alpha
    if alpha is None:
        pixels[n:, 3] = 255
    return _webp(pixels.reshape(height, width, 4))


def _webp(pixels: np.ndarray) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "WEBP", lossless=True, exact=True, quality=75, method=4)
    return out.getvalue()


def _listed(book: np.ndarray) -> list[float]:
    """The numbers with the digits of float32."""
    return [float(np.format_float_positional(x, unique=True)) for x in book]


def _bytes_a_splat(coefficients: int) -> float:
    return 15 if coefficients == 1 else 24


WRITER = FormatWriter(write_sog, _bytes_a_splat)
