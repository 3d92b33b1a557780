"""JSON files from strangers: their length is limited, errors say which file is broken, and names of files in
them are checked."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from typing import Any

from meshsplats.errors import FileFormatError

MAX_BYTES = 16 << 20
_MAX_DIGITS = 308


def read_json(path: Path, most: int = MAX_BYTES) -> Any:
    """The content of the file ``path``.

    Raises:
        FileFormatError: it is no JSON file, or has more than ``most`` bytes.
        OSError: it cannot be opened.
    """
    with open(path, "rb") as file:
        return parse_json(file.read(most + 1), most, path)


def parse_json(text: bytes, most: int, where: object) -> Any:
    """The content of ``text``; errors as ``read_json``, whose messages begin with ``where``."""
    if len(text) > most:
        raise FileFormatError(f"{where}: larger than {most >> 20} MiB, the limit for such a file")
    try:
        return json.loads(text, parse_int=_integer)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{where}: not a JSON file ({str(error)[:120]})") from None


def _integer(text: str) -> int | float:
    """A number without fraction; infinite, as 1e999 is, if it is too large for floats."""
    return int(text) if len(text) <= _MAX_DIGITS else float(text)


def json_object(text: bytes, most: int, where: object) -> dict[str, Any]:
    """``parse_json`` of what must be an object."""
    found = parse_json(text, most, where)
    if not isinstance(found, dict):
        raise FileFormatError(f"{where}: must be a JSON object")
    return found


def can_be_named(path: Path) -> bool:
    """Whether a file can have this path here: names have limits of their length and characters."""
    try:
        os.lstat(path)
    except ValueError:  # zeros, halves of surrogate pairs
        return False
    except OSError as error:
        return error.errno != errno.ENAMETOOLONG
    return True
