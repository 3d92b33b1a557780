"""AVIF photographs: as other ones, where the installed Pillow reads them."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image, features

from meshsplats.errors import FileFormatError, MissingDependencyError
from meshsplats.images import reading
from meshsplats.images.reading import load_image, read_header, read_shot
from meshsplats.training.pycolmap_input import for_pycolmap, needs_copy

READ = "avif" in features.get_supported_modules()
needs_avif = pytest.mark.skipif(not READ, reason="this Pillow was built without AVIF")
BEGIN = b"\0\0\0\x20ftypavif" + bytes(50)


@needs_avif
def test_an_avif_photograph_is_read_as_others_are(tmp_path):
    path = tmp_path / "IMG_0001.avif"
    exif = Image.Exif()
    exif[0x0110], exif[0x0112], exif[0x8769] = "Phone", 6, {0xA405: 26}
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:, :30] = (200, 100, 50)
    Image.fromarray(pixels).save(path, quality=95, exif=exif)
    header = read_header(path)
    assert (header.width, header.height, header.has_alpha, header.turn) == (60, 40, False, 1)
    seen = load_image(path).astype(int)
    assert seen.shape == (40, 60, 3)
    assert np.abs(seen - pixels)[:, :25].max() < 8
    shot = read_shot(path)
    assert (shot.size, shot.format) == ((60, 40), "AVIF")
    assert "Phone" in shot.lens
    assert "26" in shot.lens
    assert needs_copy(shot)
    (tmp_path / "work").mkdir()
    (copy,) = for_pycolmap({path: shot}, tmp_path / "work", 1)
    assert read_shot(copy).lens == shot.lens  # COLMAP takes the focal length from there


@needs_avif
def test_a_broken_avif_is_an_error_of_its_file(tmp_path):
    path = tmp_path / "a.avif"
    path.write_bytes(BEGIN)
    with pytest.raises(FileFormatError, match=r"a\.avif: "):
        load_image(path)


def test_a_pillow_without_avif_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "_reads_avif", lambda: False)
    path = tmp_path / "a.avif"
    path.write_bytes(BEGIN)
    with pytest.raises(MissingDependencyError, match=r"Pillow 11\.3 or later"):
        read_header(path)
