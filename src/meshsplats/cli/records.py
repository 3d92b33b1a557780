"""Files beside a result: names, and the configuration of the run that made it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import meshsplats
from meshsplats._common import toml
from meshsplats._common.option_values import relative_to
from meshsplats._common.words import legible
from meshsplats.cli.arguments import INVOCATION, Command, options_of, spelled
from meshsplats.cli.messages import shown_path
from meshsplats.formats.outputs import recorded_options


def write_configuration(
    path: Path, name: str, command: Command, result: Mapping[str, Any] | None = None
) -> None:
    """Writes the options of the command ``name`` to ``path``, from which --config repeats the run.
    ``result``: findings of the run."""
    from meshsplats._files.atomic import write_text

    write_text(path, toml.dumps(configuration(name, command, path.parent, result)))


def configuration(
    name: str, command: Command, folder: Path, result: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The content of a configuration file in ``folder``."""
    values = {key: option.value(command) for key, option in options_of(type(command)).items()}
    plain = {key: _plain(value, folder) for key, value in values.items()}
    resolved = {key: _plain(value, folder) for key, value in command.resolved().items()}
    return {
        "command": name,
        "version": meshsplats.__version__,
        "invocation": {key: plain[key] for key in INVOCATION if key in plain},
        "options": {key: value for key, value in plain.items() if key not in INVOCATION},
        "resolved": resolved,
        "result": dict(result or {}),
    }


def differences(
    path: Path, name: str, command: Command, idle: Collection[str] = ()
) -> dict[str, tuple[Any, Any]] | None:
    """The options of ``command`` that differ from those recorded at ``path``: what they were and are. None
    without a record of a command ``name``. ``idle``: options that do not count."""
    before = recorded_options(path, name)
    if before is None:
        return None
    now = configuration(name, command, path.parent)["options"]
    return {
        key: (before.get(key), now.get(key))
        for key in dict.fromkeys((*now, *before))
        if key not in idle and not _same(path.parent, before.get(key), now.get(key))
    }


def in_plain_words(command: Command, differ: Mapping[str, tuple[Any, Any]]) -> str:
    """``differences`` in a line, values as they are typed."""

    def shown(value: Any) -> str:
        values = value if isinstance(value, list) else [value]
        return "not given" if value is None else " ".join(map(str, values))

    return ", ".join(_compared(command, differ, shown))


def changes_since(path: Path, name: str, command: Command, idle: Collection[str] = ()) -> str | None:
    """How ``command`` differs from the one recorded at ``path``, in words: empty if it does not, None without
    a record of a command ``name``. ``idle``: options that do not change the result."""
    differ = differences(path, name, command, idle)
    if differ is None:
        return None
    found = _compared(command, dict(sorted(differ.items())), _shown)
    version, today = toml.load(path).get("version"), meshsplats.__version__
    if version != today:
        found.append(f"MeshSplats was {version} and is {today}")
    return ", ".join(found)


def _same(folder: Path, a: Any, b: Any) -> bool:
    """Whether two recorded values are equal, as paths from ``folder``, too: one may be absolute."""
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(_same(folder, x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, str) and isinstance(b, str):
        return a == b or os.path.realpath(folder / a) == os.path.realpath(folder / b)
    return bool(a == b)


def _compared(
    command: Command, differ: Mapping[str, tuple[Any, Any]], shown: Callable[[Any], str]
) -> list[str]:
    """A clause for each of the options that ``differ``, with values as they are ``shown``."""
    return [
        f"{spelled(type(command), key)} was {shown(old)} and is {shown(new)}"
        for key, (old, new) in differ.items()
    ]


def _shown(value: Any) -> str:
    return "not given" if value is None else json.dumps(value)


def _plain(value: Any, folder: Path) -> Any:
    """An option's value as TOML has it, which knows no paths."""
    if isinstance(value, (tuple, list)):
        return [_plain(part, folder) for part in value]
    if isinstance(value, Path):
        value = "-" if shown_path(value) == "-" else relative_to(value, folder)
    return legible(value) if isinstance(value, str) else value
