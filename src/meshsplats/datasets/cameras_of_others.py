"""Files of cameras that are not read, told by their names and first bytes, so that nothing is made in their
place without a word."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_HEAD = 4096


class _Kind(NamedTuple):
    name: str
    """Pattern of the whole name of the file, or of the folder if it ends in a slash; letters of any case."""
    content: bytes
    """Pattern of the first bytes of the file; empty: any."""
    what: str
    advice: str


_COLMAP = "export the cameras in COLMAP's format (cameras.txt, images.txt) with undistorted images"
_WRITE = "write them to a transforms.json"
_WRITE_OR_ANEW = f"{_WRITE}; or give the folder or video of the photographs alone to have others found"
_PLACES = ("images", "input", "Images", "params", "1_initial/params")
"""Folders in that of the data set that are looked into, too."""
_KINDS: Sequence[_Kind] = (
    _Kind(r".*\.xml", rb"<document\b[^>]*>\s*<chunk\b", "cameras of Metashape", f"{_COLMAP} instead"),
    _Kind(r".*\.xml", rb"<BlocksExchange\b", "cameras in ContextCapture's format", f"{_COLMAP} instead"),
    _Kind(r".*\.xmp", rb"xcr:(Version|Position|Rotation)", "cameras of RealityCapture", f"{_COLMAP} instead"),
    _Kind(
        r".*\.csv",
        rb"#?\s*(name|cameras)\b[^\n]*\b(x|heading|alt)\b",
        "cameras of RealityCapture",
        f"{_COLMAP} instead",
    ),
    _Kind(r".*\.out", rb"#\s*Bundle file", "cameras of Bundler", "convert them to COLMAP's format"),
    _Kind(r".*\.nvm", rb"NVM_V3", "cameras of VisualSFM", "import them into COLMAP, and export its model"),
    _Kind(r"sfm_data.*\.json", b"", "cameras of OpenMVG", "convert them: openMVG_main_openMVG2Colmap"),
    _Kind(r"sfm_data.*\.bin", b"", "cameras of OpenMVG", "convert them: openMVG_main_openMVG2Colmap"),
    _Kind(r".*\.(sfm|abc)", rb"\s*\{|Ogawa", "cameras of Meshroom", "convert them: aliceVision_exportColmap"),
    _Kind(r"reconstruction\.json", rb"\s*\[", "cameras of OpenSfM", "convert them: opensfm export_colmap"),
    _Kind(r"opensfm/|odm_.*/", b"", "cameras of OpenDroneMap", "convert them: ns-process-data odm"),
    _Kind(r".*_calibrated_camera_parameters\.txt", b"", "cameras of Pix4D", _WRITE),
    _Kind(r"odometry\.csv", rb"timestamp,\s*frame,", "cameras of Stray Scanner", _WRITE_OR_ANEW),
    _Kind(r"groundtruth\.txt", rb"#.*\btx\s+ty\s+tz\b", "cameras of a TUM RGB-D sequence", _WRITE_OR_ANEW),
    _Kind(
        r"metadata\.json",
        rb'(?-i:"(initPose|perFrameIntrinsicCoeffs|K)"\s*:\s*\[|"poses"\s*:\s*\[\s*\[)',
        "a capture of Record3D",
        "convert it: ns-process-data record3d",
    ),
    _Kind(r"keyframes/", b"", "a raw capture of Polycam", "convert it: ns-process-data polycam"),
    _Kind(r"exr_rgbd/", b"", "a capture of Record3D", "convert it: ns-process-data record3d"),
    _Kind(r".*\.r3d", b"", "a capture of Record3D", "export it as EXR + RGB, then ns-process-data record3d"),
    _Kind(r"cameras(_sphere|_large|_linear_init)?\.npz", rb"PK", "cameras of NeuS and IDR", _COLMAP),
    _Kind(r"cams(_\d)?/", b"", "cameras of MVSNet", _COLMAP),
    _Kind(r"cameras\.json", rb"\s*\[", "cameras of a 3DGS trainer", "give the folder it was trained on"),
    _Kind(r"pose/", b"", "cameras of NSVF or ScanNet", _WRITE),
    _Kind(
        r"frame_\d+\.json",
        rb'"cameraPoseARFrame"',
        "a capture of 3D Scanner App",
        _WRITE,
    ),
    _Kind(r"transforms.*\.json", rb"\{", "cameras", "give that file itself, or name it transforms.json"),
    _Kind(r"(cameras|images)\.(bin|txt)", b"", "half of COLMAP's model", "cameras and images must be there"),
    _Kind(r".*\.p4d", b"", "a project of Pix4D", "write its cameras to a transforms.json"),
    _Kind(r".*\.(psx|psz)", b"", "a project of Metashape", f"{_COLMAP} from it"),
    _Kind(r".*\.(rcproj|rsproj)", b"", "a project of RealityCapture or RealityScan", f"{_COLMAP} from it"),
)


def cameras_of_others(folder: Path) -> str:
    """What holds cameras that are not read in ``folder``, beside its images or among them, and what to do;
    empty if nothing is known to."""
    places = [folder, *(folder / name for name in _PLACES if (folder / name).is_dir())]
    for place in places:
        with os.scandir(place) as entries:
            listed = sorted((entry.name + "/" * entry.is_dir() for entry in entries), key=str.casefold)
        for name in listed:
            kind = _kind(place, name)
            if kind is not None:
                shown = (place / name).relative_to(folder).as_posix() + "/" * name.endswith("/")
                return f"{shown} is there, {kind.what}, which is not read: {kind.advice}"
    return ""


def _kind(place: Path, name: str) -> _Kind | None:
    if name.startswith("."):
        return None
    for kind in _KINDS:
        if not re.fullmatch(kind.name, name, re.IGNORECASE):
            continue
        if not kind.content:
            return kind
        try:
            with open(place / name, "rb") as file:
                head = file.read(_HEAD)
        except OSError:
            continue
        if re.search(kind.content, head.removeprefix(b"\xef\xbb\xbf"), re.IGNORECASE):
            return kind
    return None
