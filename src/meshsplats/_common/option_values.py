"""Values of options: from the text of --set, and from configuration files."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from meshsplats._common.options import alternatives


def from_text(text: str, hint: Any) -> Any:
    """``text`` as a configuration file would have it for an option of this type; as it is if it does not fit.
    Lists have commas."""
    for kind in alternatives(hint):
        if get_origin(kind) is tuple:
            return [from_text(part, get_args(kind)[0]) for part in text.split(",")]
        if get_origin(kind) is Literal and (fitting := [c for c in get_args(kind) if str(c) == text]):
            return fitting[0]
        if kind is bool and text.lower() in ("true", "false"):
            return text.lower() == "true"
        if kind in (int, float):
            with suppress(ValueError):
                return kind(text)
    return text


def converted(value: Any, hint: Any, folder: Path) -> Any:
    """``value`` of a file in ``folder`` as an option of the type ``hint``. A TypeError says what it must
    be."""
    problems = []
    for kind in alternatives(hint):
        if kind is type(None):
            continue
        try:
            return _as_kind(value, kind, folder)
        except TypeError as error:
            problems.append(str(error))
    raise TypeError(" or ".join(problems))


def _as_kind(value: Any, kind: Any, folder: Path) -> Any:
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        if value in choices and type(value) in map(type, choices):
            return value
        raise TypeError("one of " + ", ".join(map(str, choices)))
    if get_origin(kind) is tuple:
        return _as_tuple(value, get_args(kind), folder)
    if kind is bool and isinstance(value, bool):
        return value
    whole = isinstance(value, int) and not isinstance(value, bool) and value.bit_length() < 64
    if kind is int and whole:
        return value
    if kind is float and (whole or isinstance(value, float)):
        return float(value)
    if kind in (str, Path) and isinstance(value, str) and "\0" not in value:
        return value if kind is str else resolve(value, folder)
    raise TypeError(_KINDS[kind])


_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "a path"}


def _as_tuple(value: Any, kinds: tuple[Any, ...], folder: Path) -> tuple[Any, ...]:
    endless = kinds[-1] is Ellipsis
    if not isinstance(value, list) or (not endless and len(value) != len(kinds)):
        raise TypeError("a list" if endless else f"a list of {len(kinds)} values")
    try:
        parts = [converted(v, kinds[0 if endless else i], folder) for i, v in enumerate(value)]
    except TypeError as error:
        raise TypeError(f"a list, each {error}") from None
    return tuple(parts)


def short(value: Any) -> str:
    """``value`` for a message, in printable characters."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, int) and value.bit_length() > 64:
        return "more than 64 bits"
    text = ascii(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


# ---- Paths in configuration files are relative to the file's folder, so that it works from everywhere


def resolve(text: str, folder: Path) -> Path:
    """The path ``text`` of a file in ``folder``, seen from the working folder."""
    path = Path(text)
    if path.is_absolute():
        return path
    whole = os.path.normpath(os.path.join(os.path.realpath(folder), text))
    return Path(whole if folder.is_absolute() else _relative(whole, os.path.realpath(".")))


def relative_to(path: Path, folder: Path) -> str:
    """``path``, relative to the working folder, for a file in ``folder``. Absolute ones stay."""
    if path.is_absolute():
        return str(path)
    whole = os.path.join(os.path.realpath(path.parent), path.name)
    return Path(_relative(whole, os.path.realpath(folder))).as_posix()


def _relative(path: str, start: str) -> str:
    try:
        return os.path.relpath(path, start)
    except ValueError:  # another drive
        return path
