"""TOML files: a writer for plain values, and a reader for files from strangers."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from meshsplats._common.words import legible

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_BYTES = 1 << 16
MAX_LINE = 5000
"""The reader's time grows with the square of a line's length: "a.a.a..." nests a table in each dot."""
_WIDTH = 100
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_ESCAPES = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\r": "\\r", "\t": "\\t"}


def dumps(record: Mapping[str, Any]) -> str:
    """``record`` of text, numbers, booleans, lists and tables as TOML, without values that are None."""
    return "\n".join(_lines(record, ())).lstrip("\n") + "\n"


def load(path: Path) -> dict[str, Any]:
    """The content of the file at ``path``.

    Raises:
        OSError: it cannot be read.
        ValueError: it is larger than ``MAX_BYTES``, or no TOML.
    """
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ValueError(f"{path}: larger than {MAX_BYTES >> 10} KiB: not a configuration")
    if max(map(len, data.splitlines()), default=0) > MAX_LINE:
        raise ValueError(f"{path}: a line is longer than {MAX_LINE:,} bytes: not a configuration")
    try:
        return tomllib.loads(data.decode("utf-8"))
    except RecursionError:
        raise ValueError(f"{path}: not a TOML file: nested too deeply") from None
    except ValueError as error:
        message = " ".join(str(error).split())
        raise ValueError(f"{path}: not a TOML file: {message[:200]}") from None


def _lines(table: Mapping[str, Any], above: tuple[str, ...]) -> Iterator[str]:
    for key, value in table.items():
        if value is not None and not isinstance(value, Mapping):
            yield f"{_key(key)} = {_value(value)}"
    for key, value in table.items():
        if isinstance(value, Mapping) and value:
            path = (*above, _key(key))
            if any(not isinstance(part, Mapping) for part in value.values()):
                yield f"\n[{'.'.join(path)}]"
            yield from _lines(value, path)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _text(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, (list, tuple)):
        parts = [_value(part) for part in value]
        joined = ", ".join(parts)
        return f"[{joined}]" if len(joined) <= _WIDTH else "[\n" + "".join(f"  {p},\n" for p in parts) + "]"
    if isinstance(value, (int, float)):
        return repr(value)
    raise TypeError(f"no value for TOML: {type(value).__name__}")


def _text(text: str) -> str:
    escaped = (_ESCAPES.get(c) or (c if _plain(c) else f"\\u{ord(c):04x}") for c in legible(text))
    return '"' + "".join(escaped) + '"'


def _plain(character: str) -> bool:
    return " " <= character != "\x7f"
