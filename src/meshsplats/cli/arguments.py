"""Parses command lines and configuration files; prints help."""

from __future__ import annotations

import ast
import inspect
import os
import re
import textwrap
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro

from meshsplats import _toml as toml
from meshsplats._options import did_you_mean
from meshsplats.cli.messages import OK, UsageError, flag, say

T = TypeVar("T")
C = TypeVar("C", bound="Command")
INVOCATION = ("cluster", "executable", "force", "json", "resume", "skip_existing")
"""Options for the command line only: a configuration file from a stranger must neither overwrite files nor
run programs, here or on a cluster, and --json, --resume and --skip-existing belong to a single call."""
TABLES = ("command", "version", "invocation", "options", "resolved", "result")
"""Tables and keys of a configuration file. Only ``options`` is read."""
_MARKERS = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)


class Command:
    """Base of the commands: dataclasses whose fields are the options."""

    COMMON: ClassVar[tuple[str, ...]] = ()
    """Options in --help. Empty: all."""
    EXCLUSIVE: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """Groups of options that exclude each other: one on the command line replaces those of a configuration
    file."""
    CONFIGURABLE: ClassVar[bool] = False
    """Whether the command writes a configuration, and reads one with --config."""

    def execute(self) -> int | None:
        """Does the work; the exit code, None for 0."""
        raise NotImplementedError

    def resolved(self) -> dict[str, Any]:
        """The values that options and presets lead to."""
        return {}


@dataclass(frozen=True)
class Option:
    """A field of a command or of one of its groups."""

    path: tuple[str, ...]
    """Names of the groups and of the field."""
    hint: Any

    def value(self, command: object) -> Any:
        for name in self.path:
            command = getattr(command, name)
        return command


def parse(command: type[C], prog: str, words: Sequence[str]) -> C:
    """The command that ``words`` describe.

    Raises:
        SystemExit: after --help (0), or for words that are not understood (2), which has been printed.
        UsageError: for a configuration file that is wrong.
        ValueError: --threads is below 1.
    """
    made = _parsed(command, prog, words)
    option = options_of(command).get("threads")
    if option is not None and (count := option.value(made)) is not None and count < 1:
        raise ValueError(f"--threads must be at least 1, got {count}")  # before the work: images come last
    return made


def _parsed(command: type[C], prog: str, words: Sequence[str]) -> C:
    words, file = _without_config(words)
    if any(word in words for word in ("-h", "--help", "--help-all")):
        _print_help(command, prog, everything="--help-all" in words)
        raise SystemExit(OK)
    if file is None:
        return tyro.cli(command, prog=prog, args=words, config=_MARKERS)
    if not command.CONFIGURABLE:
        raise UsageError("--config has no effect here: this command writes no configuration")
    values, resolved = _read(command, file, prog.rpartition(" ")[2])
    _warn_of_changes(command, file, values, resolved)
    on_line = {word.partition("=")[0].lstrip("-").replace("-", "_") for word in words if word[:2] == "--"}
    for group in command.EXCLUSIVE:
        if on_line & set(group):
            values = {name: value for name, value in values.items() if name not in group}
    # --no-FLAG clears a flag that the file sets.
    return tyro.cli(command, prog=prog, args=words, default=_filled(command, values), config=_MARKERS[:1])


def options_of(command: type) -> dict[str, Option]:
    """The options of ``command`` by their names, those of its groups included."""
    found: dict[str, Option] = {}
    hints = get_type_hints(command)
    for part in fields(command):
        hint = hints[part.name]
        if is_dataclass(hint):
            assert isinstance(hint, type)
            for name, inner in options_of(hint).items():
                found[name] = Option((part.name, *inner.path), inner.hint)
        elif hint is not object:
            found[part.name] = Option((part.name,), hint)
    return found


def as_cli_options(
    options: type[T],
    about: str,
    *,
    without: Collection[str] = (),
    metavars: Mapping[str, str] = types.MappingProxyType({}),
    defaults: Callable[[str], str] = lambda name: "",
    flags: bool = False,
    checked: bool = True,
) -> type[T]:
    """A library's dataclass of options as a group of the command line, where each may be left out and is then
    None. Their docstrings are the help.

    Args:
        options: the dataclass.
        about: description of the group.
        without: names of options that the command line lacks.
        metavars: placeholders for values; by default N, X or the choices.
        defaults: the end of an option's help, by its name.
        flags: booleans are flags and False by default.
        checked: whether values are checked at once, by ``__post_init__``.
    """
    hints: dict[str, Any] = {}
    values: dict[str, Any] = {} if checked else {"__post_init__": lambda self: None}
    for name, hint in get_type_hints(options).items():
        kind = _alternatives(hint)[0]
        values[name] = None
        if name in without:
            hints[name] = tyro.conf.Suppress[object]
        elif kind is bool and flags:
            hints[name], values[name] = bool, False
        else:
            choices = "{" + ",".join(map(str, get_args(kind))) + "}"
            placeholders = {int: "N", float: "X", bool: "{True,False}"}
            metavar = metavars.get(name) or placeholders.get(kind, choices)
            argument = tyro.conf.arg(metavar=metavar, help_behavior_hint=defaults(name))
            hints[name] = Annotated[hint | None, argument]
    made = type(options.__name__, (options,), {"__annotations__": hints, "__doc__": about, **values})
    return dataclass(frozen=True)(made)


def _without_config(words: Sequence[str]) -> tuple[list[str], Path | None]:
    """``words`` without --config, and its file."""
    rest: list[str] = []
    file: str | None = None
    remaining = iter(words)
    for word in remaining:
        name, equals, value = word.partition("=")
        if name != "--config":
            rest.append(word)
            continue
        if file is not None:
            raise UsageError("give one --config")
        file = value if equals else next(remaining, "")
        if not file:
            raise UsageError("--config needs a file")
    return rest, None if file is None else Path(file)


def _print_help(command: type[Command], prog: str, *, everything: bool) -> None:
    options, common = options_of(command), command.COMMON
    hidden = [] if everything or not common else [name for name in options if name not in common]
    shown = _described(command, [name for name in options if name not in hidden], options)
    with suppress(SystemExit):
        tyro.cli(shown, prog=prog, args=["--help"], config=_MARKERS)
    notes = [f"{len(hidden)} more options: --help-all."] if hidden else []
    if command.CONFIGURABLE:
        notes.append("--config FILE takes options from the NAME.config.toml of an earlier run.")
        if everything:
            notes.append("Paths in it are relative to its folder. Options on the command line win.")
    if notes:
        print(" ".join(notes))


def _described(command: type[T], shown: Collection[str], options: Collection[str]) -> type[T]:
    """``command`` with help for the options ``shown``; the others are hidden. ``options``: names of all."""
    hints: dict[str, Any] = {}
    values: dict[str, Any] = {}
    texts = _docstrings(command)
    for name, hint in get_type_hints(command, include_extras=True).items():
        part = command.__dataclass_fields__.get(name)  # type: ignore[attr-defined]
        if part is None or get_origin(hint) is ClassVar:
            continue
        if is_dataclass(hint):
            hints[name] = _described(hint, shown, options)  # type: ignore[arg-type]
            values[name] = field(default_factory=hints[name])
            continue
        if part.default is not MISSING:
            values[name] = part.default
        if name not in shown:
            hint = Annotated[hint, tyro.conf.Suppress]
        elif name in texts:  # else its type has the help, for options of several commands
            hint = Annotated[hint, tyro.conf.arg(help=_with_flags(texts[name], options))]
        hints[name] = hint
    made = type(
        command.__name__, (command,), {"__annotations__": hints, "__doc__": command.__doc__, **values}
    )
    return dataclass(frozen=True)(made)


def _docstrings(kind: type) -> dict[str, str]:
    """The docstrings of a dataclass' fields, each in one line. (Tyro keeps the line breaks of the source.)"""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        try:
            source = textwrap.dedent(inspect.getsource(base))
        except (OSError, TypeError):  # made at run time, or built in
            continue
        for node, text in pairwise(ast.parse(source).body[0].body):  # type: ignore[attr-defined]
            if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
                continue
            if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                found[node.target.id] = " ".join(str(text.value.value).split())
    return found


def _with_flags(text: str, options: Collection[str]) -> str:
    """``text`` without double backquotes; the names of ``options`` in them become flags."""
    return re.sub("``(.+?)``", lambda match: flag(match[1]) if match[1] in options else match[1], text)


# ---- Configuration files


def _read(command: type[Command], file: Path, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The options in ``file``, and the values that it says they lead to."""
    try:
        record = toml.load(file)
    except ValueError as error:
        raise UsageError(str(error)) from None
    _refuse_unknown(record, TABLES, f"{file}: no such table or key")
    if record.get("command", name) != name:
        raise UsageError(f"{file}: of the command {_short(record['command'])}, not {name}")
    table, resolved = record.get("options", {}), record.get("resolved", {})
    for title, part in (("options", table), ("resolved", resolved)):
        if not isinstance(part, dict):
            raise UsageError(f"{file}: {title} must be a table, got {_short(part)}")
    options = options_of(command)
    for option in INVOCATION:
        if option in table:
            raise UsageError(f"{file}: {flag(option)} is for the command line only")
    _refuse_unknown(table, options, f"{file}: {name} has no option")
    values = {}
    for key, value in table.items():
        if key == "input" and value in ("-", ["-"]):
            continue  # standard input has to be named again
        try:
            values[key] = _converted(value, options[key].hint, file.parent)
        except TypeError as error:
            raise UsageError(f"{file}: {key} must be {error}, got {_short(value)}") from None
    return values, resolved


def _refuse_unknown(table: Mapping[str, Any], known: Collection[str], problem: str) -> None:
    for key in table:
        if key not in known:
            hint = did_you_mean(key[:60], known)
            raise UsageError(f"{problem} {_short(key)}" + (f"; {hint}" if hint else ""))


def _warn_of_changes(
    command: type[Command], file: Path, values: Mapping[str, Any], recorded: Mapping[str, Any]
) -> None:
    """Warns if the options no longer lead to the recorded values: someone has edited these in place of the
    options, or a preset has changed."""
    try:
        now = _filled(command, values).resolved()
    except (UsageError, OSError, ValueError, TypeError):
        return  # the command itself reports it
    for key, value in now.items():
        plain = list(value) if isinstance(value, tuple) else value
        if key in recorded and not isinstance(value, Path) and plain != recorded[key]:
            say(
                f"warning: {file}: {key} is {_short(plain)} now, and was {_short(recorded[key])}:"
                " [resolved] is a record; values are set under [options]"
            )
            return


def _filled(command: type[T], values: Mapping[str, Any]) -> T:
    """``command`` with ``values`` of its options, and defaults for the others."""
    arguments: dict[str, Any] = {}
    hints = get_type_hints(command)
    for part in fields(command):  # type: ignore[arg-type]
        hint = hints[part.name]
        if is_dataclass(hint):
            assert isinstance(hint, type)
            arguments[part.name] = _filled(hint, values)
        elif part.name in values and hint is not object:
            arguments[part.name] = values[part.name]
        elif part.default is MISSING and part.default_factory is MISSING:
            arguments[part.name] = tyro.MISSING
    return command(**arguments)


def _converted(value: Any, hint: Any, folder: Path) -> Any:
    """``value`` of a file in ``folder`` as an option of the type ``hint``. A TypeError says what it must
    be."""
    problems = []
    for kind in _alternatives(hint):
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
        parts = [_converted(v, kinds[0 if endless else i], folder) for i, v in enumerate(value)]
    except TypeError as error:
        raise TypeError(f"a list, each {error}") from None
    return tuple(parts)


def _alternatives(hint: Any) -> tuple[Any, ...]:
    """The types of a union, without None."""
    if get_origin(hint) in (Union, types.UnionType):
        return tuple(part for part in get_args(hint) if part is not type(None))
    return (hint,)


def _short(value: Any) -> str:
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
