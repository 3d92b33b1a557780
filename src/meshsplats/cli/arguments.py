"""Parses command lines and configuration files; prints help."""

from __future__ import annotations

import io
import json
import textwrap
import types
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, make_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_type_hints

import tyro

from meshsplats._common import toml
from meshsplats._common.help_titles import Captured, titled
from meshsplats._common.misuse import Usage, in_one_line, misuse
from meshsplats._common.option_values import converted, from_text, short
from meshsplats._common.options import check_naming, did_you_mean, reachable, settings
from meshsplats.cli.messages import OK, UsageError, flag, say, with_flags
from meshsplats.errors import OptionValueError, with_options

T = TypeVar("T")
C = TypeVar("C", bound="Command")
INVOCATION = ("cluster", "executable", "force", "json", "resume", "skip_existing")
"""Options for the command line only: a configuration file from a stranger must neither overwrite files nor
run programs, here or on a cluster, and --json, --resume and --skip-existing belong to a single call."""
TABLES = ("command", "version", "invocation", "options", "resolved", "result")
"""Tables and keys of a configuration file. Only ``options`` is read."""
_MARKERS = (tyro.conf.OmitArgPrefixes, tyro.conf.SuppressFixed, tyro.conf.FlagCreatePairsOff)
# Without the docstrings of fields, whose reading takes half of the time of parsing; --help has them from
# ``_described``.
_PARSED = (*_MARKERS, tyro.conf.HelptextFromCommentsOff)
_FILLED = (*_PARSED[:2], tyro.conf.HelptextFromCommentsOff)  # --no-FLAG clears a flag that the file sets


class Flat:
    """Marks a group whose options the help shows among those of the command itself."""


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

    def finish(self, result: Any, *lines: str, indent: int | None = 1) -> None:
        """Prints what came out: ``lines``, or with --json the ``result``."""
        as_json = getattr(self, "json", False)
        shown = [json.dumps(result, indent=indent, default=str)] if as_json else map(with_flags, lines)
        print(*shown, sep="\n", flush=True)


@dataclass(frozen=True)
class Option:
    """A field of a command or of one of its groups."""

    path: tuple[str, ...]
    """Names of the groups and of the field."""
    hint: Any
    has_flag: bool
    """Whether it has a flag of its own. Fields that are ``tyro.conf.Fixed`` have none: --set or a
    configuration file sets them."""
    part: tuple[str, Any, Any]
    """Name, type with its marks, and default, as ``make_dataclass`` takes them."""

    @property
    def without_flag(self) -> bool:
        """Whether it may be given without its flag: by its place, or by a short one; or has to be given."""
        short = any(getattr(mark, "aliases", None) for mark in getattr(self.part[1], "__metadata__", ()))
        return short or self.positional or isinstance(self.part[2], Field)

    @property
    def positional(self) -> bool:
        return tyro.conf.Positional in getattr(self.part[1], "__metadata__", ())

    def value(self, command: object) -> Any:
        for name in self.path:
            command = getattr(command, name)
        return command


@dataclass(frozen=True)
class Line:
    """The words of a command line, without --config and --set."""

    words: list[str]
    config: Path | None
    settings: dict[str, str]
    """The texts of --set NAME=VALUE."""


def parse(command: type[C], prog: str, words: Sequence[str]) -> C:
    """The command that ``words`` describe.

    Raises:
        SystemExit: after --help.
        UsageError: for words, --set or a configuration file that are wrong.
    """
    made = _parsed(command, prog, _taken_apart(words))
    option = options_of(command).get("threads")
    if option is not None and (count := option.value(made)) is not None and count < 1:
        raise UsageError(f"--threads must be at least 1, got {count}")  # before the work: images come last
    return made


def _parsed(command: type[C], prog: str, line: Line) -> C:
    if any(word in line.words for word in ("-h", "--help", "--help-all")):
        _print_help(command, prog, everything="--help-all" in line.words)
        raise SystemExit(OK)
    flags = {word.partition("=")[0] for word in line.words if word[:2] == "--"}
    for name in (name for name, option in options_of(command).items() if not option.has_flag):
        if flag(name) in flags:
            raise UsageError(f"{flag(name)} is not an option of its own: write --set {name}=VALUE")
    if line.config is None and not line.settings:
        return _with_given(command, prog, line.words, flags)
    name = prog.rpartition(" ")[2]
    given = _read_settings(command, line.settings, flags, name)
    values: dict[str, Any] = {}
    if line.config is not None:
        if not command.CONFIGURABLE:
            raise UsageError("--config has no effect here: this command writes no configuration")
        values, resolved = _read(command, line.config, name)
        _warn_of_changes(command, line.config, values, resolved)
    for group in command.EXCLUSIVE:
        if any(flag(option) in flags or option in given for option in group):
            values = {option: value for option, value in values.items() if option not in group}
    return _with_all(command, prog, line.words, values | given)


def _with_given(command: type[C], prog: str, words: list[str], flags: Collection[str]) -> C:
    """``command`` as ``words`` describe it: parsed with none but the options in ``flags`` and those that need
    none, which takes a tenth of the time, and with all of them where that fails, to say why."""
    named = [
        option.part
        for name, option in options_of(command).items()
        if option.has_flag and (flag(name) in flags or option.without_flag)
    ]
    given = make_dataclass(command.__name__, named, frozen=True)
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            found: Any = tyro.cli(given, prog=prog, args=words, config=_PARSED)
        return _filled(command, vars(found))
    except (SystemExit, ValueError):
        return _with_all(command, prog, words)


def _with_all(command: type[C], prog: str, words: list[str], values: Mapping[str, Any] | None = None) -> C:
    """``command`` as ``words`` describe it, where ``values`` of a configuration are not replaced."""
    how: dict[str, Any] = {"config": _PARSED if values is None else _FILLED}
    how |= {} if values is None else {"default": _filled(command, values)}
    printed = io.StringIO()
    try:
        with redirect_stderr(printed):
            return tyro.cli(command, prog=prog, args=words, **how)
    except SystemExit as stop:
        if not stop.code:
            raise  # it has printed what was asked for
        raise UsageError(misuse(words, _usage(command, values)) or in_one_line(printed.getvalue())) from None


def _usage(command: type, filled: Collection[str] | None) -> Usage:
    """What ``command`` takes; ``filled``: names of options that a configuration has, None without one."""
    parts = {name: option for name, option in options_of(command).items() if option.has_flag}
    shown = {name: name if option.positional else flag(name) for name, option in parts.items()}
    start = {name: option.part[2] for name, option in parts.items() if name not in (filled or ())}
    needed = [shown[name] for name in start if start[name] is tyro.MISSING or isinstance(start[name], Field)]
    kinds = {shown[name]: parts[name].hint for name in parts}
    return Usage(kinds, needed, {"-o": "--output"}, negatable=filled is not None)


def _default(part: Field[Any]) -> Any:
    return field() if part.default is MISSING else part.default


def _find_options(command: type) -> Mapping[str, Option]:
    found: dict[str, Option] = {}
    hints, marked = get_type_hints(command), get_type_hints(command, include_extras=True)
    for part in fields(command):
        hint = hints[part.name]
        if is_dataclass(hint):
            assert isinstance(hint, type)
            for name, inner in options_of(hint).items():
                found[name] = replace(inner, path=(part.name, *inner.path))
        elif hint is not object:
            has_flag = tyro.conf.Fixed not in getattr(marked[part.name], "__metadata__", ())
            whole = (part.name, marked[part.name], _default(part))
            found[part.name] = Option((part.name,), hint, has_flag, whole)
    return types.MappingProxyType(found)


options_of: Callable[[type], Mapping[str, Option]] = lru_cache(_find_options)
"""The options of a command by their names, those of its groups included."""


def spelled(command: type, name: str) -> str:
    """The option ``name`` of ``command`` for a message: its flag, or how --set has it."""
    option = options_of(command).get(name)
    if name == "output":
        return "-o"
    return flag(name) if option is None or option.has_flag else f"--set {name}"


@contextmanager
def usage_errors() -> Iterator[None]:
    """Within the block, an OptionValueError of the library becomes a UsageError."""
    try:
        yield
    except OptionValueError as error:
        raise UsageError(*error.args) from None


def as_cli_options(
    about: str | None = None,
    *,
    without: Collection[str] = (),
    metavars: Mapping[str, str] = types.MappingProxyType({}),
    defaults: Callable[[str], str] = lambda name: "",
    flags: bool = False,
    presets: bool = True,
    checked: bool = True,
) -> Callable[[type[T]], type[T]]:
    """Makes of a class whose base is a library's dataclass of options a group of the command line. Help,
    placeholders and whether an option has a flag follow from the fields (``options.settings``).

    Args:
        about: description of the group; by default the docstring of the class.
        without: names of options that the command lacks, beside those that cannot be changed.
        metavars: placeholders for values; by default ``Setting.placeholder``.
        defaults: the end of an option's help, by its name.
        flags: booleans are flags and False by default.
        presets: options that are left out are None, as presets have their values; else they are those of the
            library.
        checked: whether values are checked at once, by ``__post_init__``.
    """

    def made(group: type[T]) -> type[T]:
        parts: list[tuple[str, Any, Any]] = []
        known, hints = reachable(group), get_type_hints(group)
        marked = get_type_hints(group, include_extras=True)
        for name, setting in settings(group).items():
            start: Any = None if presets else setting.default
            hint: Any = hints[name] | None if presets and not is_dataclass(hints[name]) else hints[name]
            if name in vars(group):  # declared again, for the command line
                hint = marked[name]
            elif name in without or name not in known:
                hint = tyro.conf.Suppress[object]
            elif setting.advanced:
                hint = Annotated[hint, tyro.conf.Fixed]
            elif bool in setting.kinds and flags:
                hint, start = bool, False
            elif is_dataclass(hint):
                start = field(default_factory=hint)  # type: ignore[arg-type]
            elif presets or setting.optional:
                metavar = metavars.get(name) or setting.placeholder
                end = "" if "Default:" in setting.help else defaults(name)
                hint = Annotated[hint, tyro.conf.arg(metavar=metavar, help_behavior_hint=end)]
            parts.append((name, hint, start))
        names: dict[str, Any] = {"__doc__": about or group.__doc__, "__module__": group.__module__}
        names["__post_init__"] = check_naming(group, flag) if checked else lambda self: None
        return make_dataclass(group.__name__, parts, bases=(group,), namespace=names, frozen=True)

    return made


def _taken_apart(words: Sequence[str]) -> Line:
    """``words`` with --config and --set taken out."""
    rest: list[str] = []
    found: dict[str, list[str]] = {"--config": [], "--set": []}
    remaining = iter(words)
    for word in remaining:
        name, equals, value = word.partition("=")
        if name in found:
            found[name].append(value if equals else next(remaining, ""))
        else:
            rest.append(word)
    if len(found["--config"]) > 1:
        raise UsageError("give one --config")
    if "" in found["--config"]:
        raise UsageError("--config needs a file")
    settings: dict[str, str] = {}
    for text in found["--set"]:
        name, equals, value = text.partition("=")
        name = name.replace("-", "_")
        if not equals or not name:
            raise UsageError(f"--set takes NAME=VALUE, got {short(text)}")
        if name in settings:
            raise UsageError(f"--set {name} is given twice")
        settings[name] = value
    return Line(rest, Path(found["--config"][0]) if found["--config"] else None, settings)


def _read_settings(
    command: type[Command], texts: Mapping[str, str], flags: Collection[str], name: str
) -> dict[str, Any]:
    """The values of --set NAME=VALUE."""
    options = options_of(command)
    _refuse_unknown(texts, options, f"--set: {name} has no option")
    values = {}
    for key, text in texts.items():
        if flag(key) in flags:
            raise UsageError(f"give {flag(key)} or --set {key}, not both")
        try:
            values[key] = converted(from_text(text, options[key].hint), options[key].hint, Path())
        except TypeError as error:
            raise UsageError(f"--set: {key} must be {error}, got {short(text)}") from None
    return values


def _print_help(command: type[Command], prog: str, *, everything: bool) -> None:
    options, common = options_of(command), command.COMMON
    flags = [name for name, option in options.items() if option.has_flag]
    hidden = [] if everything or not common else [name for name in flags if name not in common]
    shown = _described(command, [name for name in flags if name not in hidden], flags)
    with suppress(SystemExit), redirect_stdout(Captured()) as printed:
        tyro.cli(shown, prog=prog, args=["--help"], config=_PARSED)
    print(titled(printed.getvalue()), end="")
    others = [name for name, option in options.items() if not option.has_flag]
    notes = [f"{len(hidden)} more options: --help-all."] if hidden else []
    if command.CONFIGURABLE:
        notes.append("--config FILE takes options from the NAME.config.toml of an earlier run.")
        if everything:
            notes.append("Paths in it are relative to its folder. Options on the command line win.")
    if others and (everything or not hidden):
        text = f"--set NAME=VALUE sets further options (docs/options.md): {', '.join(others)}."
        print(textwrap.fill(text, 80, break_on_hyphens=False))
    if notes:
        print(" ".join(notes))


def _described(command: type[T], shown: Collection[str], flags: Collection[str], about: str = "") -> type[T]:
    """A class like ``command`` with help for the options ``shown``, and without the others. ``flags``: names
    of all that have one. ``about``: its description, in place of its docstring."""
    parts, names = _described_parts(command, shown, flags), {"__doc__": about or command.__doc__}
    return make_dataclass(command.__name__, parts, namespace=names, frozen=True)


def _described_parts(
    command: type, shown: Collection[str], flags: Collection[str]
) -> list[tuple[str, Any, Any]]:
    parts: list[tuple[str, Any, Any]] = []
    known, hints = settings(command), get_type_hints(command, include_extras=True)
    named = {name: flag(name) for name in flags}
    for part in fields(command):
        hint, name = hints[part.name], part.name
        if Flat in getattr(hint, "__metadata__", ()):
            parts += _described_parts(hint.__origin__, shown, flags)
        elif is_dataclass(hint):
            inner = _described_parts(hint, shown, flags)  # type: ignore[arg-type]
            if len(inner) > 1:  # one option needs no box of its own
                group = _described(hint, shown, flags, known[name].help)  # type: ignore[arg-type]
                inner = [(name, group, field(default_factory=group))]
            parts += inner
        elif name in shown and getattr(hint, "__origin__", hint) is not object:
            if known[name].help:  # else its type has the help, for options of several commands
                hint = Annotated[
                    hint, tyro.conf.arg(help=with_options(known[name].text, lambda key: named.get(key, key)))
                ]
            parts.append((name, hint, _default(part)))
    return parts


# ---- Configuration files


def _read(command: type[Command], file: Path, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The options in ``file``, and the values that it says they lead to."""
    try:
        record = toml.load(file)
    except ValueError as error:
        raise UsageError(str(error)) from None
    _refuse_unknown(record, TABLES, f"{file}: no such table or key")
    if record.get("command", name) != name:
        raise UsageError(f"{file}: of the command {short(record['command'])}, not {name}")
    table, resolved = record.get("options", {}), record.get("resolved", {})
    for title, part in (("options", table), ("resolved", resolved)):
        if not isinstance(part, dict):
            raise UsageError(f"{file}: {title} must be a table, got {short(part)}")
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
            values[key] = converted(value, options[key].hint, file.parent)
        except TypeError as error:
            raise UsageError(f"{file}: {key} must be {error}, got {short(value)}") from None
    return values, resolved


def _refuse_unknown(table: Mapping[str, Any], known: Collection[str], problem: str) -> None:
    for key in table:
        if key not in known:
            hint = did_you_mean(key[:60], known)
            raise UsageError(f"{problem} {short(key)}" + (f"; {hint}" if hint else ""))


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
                f"warning: {file}: {key} is {short(plain)} now, and was {short(recorded[key])}:"
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
