"""Options as fields of dataclasses: what a field declares, checks of values, misspelt names.

Name, type, default, range and help of an option stand in one place, its field:

    ssim_weight: Annotated[float, Range(0, 1), Advanced] = 0.4
    '''Weight of SSIM against L1 in the loss.'''

Checks, the options of the command line and ``docs/options.md`` follow from it. Numbers of type int are whole;
a ``Literal`` lists choices; what may be None has ``| None``.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import math
import sys
import types
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from itertools import pairwise
from numbers import Real
from typing import Annotated, Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from meshsplats.errors import OptionsError, OptionValueError

M = TypeVar("M")
NUMBERS = (Real,)
"""Numbers of Python and of NumPy, which is not imported for help."""

PLACEHOLDERS = {
    **{"data": "FOLDER", "images": "FOLDER", "up": "TEXT", "background": "TEXT", "title": "TEXT"},
    **dict.fromkeys(("before", "cameras", "collider", "executable", "hdri", "splats", "surface"), "FILE"),
    **dict.fromkeys(("texture", "with_mesh"), "FILE"),
    **{"crop": "X0 Y0 Z0 X1 Y1 Z1", "look_at": "X Y Z", "sun": "AZIMUTH ELEVATION"},
}
"""What stands in help for values of options that their types do not tell."""


@dataclass(frozen=True)
class Range:
    """Least and greatest value of a number, both included."""

    low: float
    high: float

    def __str__(self) -> str:
        if self.high == math.inf:
            return f"of at least {_digits(self.low)}"
        return f"from {_digits(self.low)} to {_digits(self.high)}"


def _digits(value: float) -> str:
    """A limit as people write it: one that is an int with all its digits."""
    return str(value) if isinstance(value, int) else f"{value:.7g}"


@dataclass(frozen=True)
class Help:
    """Help of an option that is made of other values, in place of the docstring of its field."""

    text: str


class Advanced:
    """Marks options that few people set: they have no flag of their own (``--set NAME=VALUE``)."""


class With:
    """Marks an option that has an effect only with others: ``With("soft_share")`` where that is neither 0 nor
    None nor False, ``With(opacity="cutoff")`` where it has this value, or one of a tuple of values. One of
    several conditions is enough."""

    def __init__(self, *names: str, **values: Any) -> None:
        self.names = names
        self.values = {k: v if isinstance(v, tuple) else (v,) for k, v in values.items()}

    def __str__(self) -> str:
        return " or ".join(
            [f"``{name}``" for name in self.names]
            + [f"``{name}`` {value!r}" for name, known in self.values.items() for value in known]
        )

    def met(self, options: object) -> bool:
        """Whether the option has an effect among these."""
        return any(getattr(options, name) for name in self.names) or any(
            getattr(options, name) in known for name, known in self.values.items()
        )


@dataclass(frozen=True)
class Fixed:
    """Marks an option of a base class that must keep its default."""

    why: str
    """End of a sentence: why, and what to do."""


@dataclass(frozen=True)
class Setting:
    """An option, as its field declares it."""

    name: str
    kinds: tuple[Any, ...]
    """Its types, without None."""
    optional: bool
    """Whether it may be None."""
    default: Any
    """``dataclasses.MISSING`` where there is none."""
    marks: tuple[Any, ...]
    """What else stands in ``Annotated``, in the nearest class that says it."""
    owner: type
    """Its class."""

    @property
    def help(self) -> str:
        """The docstring of the field in one line, or its ``Help``."""
        own = self.mark(Help)
        return docstrings(self.owner).get(self.name, "") if own is None else own.text

    @property
    def text(self) -> str:
        """``help``, and what the option needs to have an effect."""
        condition = self.mark(With)
        return self.help if condition is None else f"{self.help} Only with {condition}."

    def mark(self, kind: type[M]) -> M | None:
        """Its mark of this kind."""
        return next((mark for mark in self.marks if isinstance(mark, kind)), None)

    @property
    def advanced(self) -> bool:
        return Advanced in self.marks

    @property
    def choices(self) -> tuple[Any, ...]:
        """The values of a ``Literal``; none for other types."""
        only = self.kinds[0] if len(self.kinds) == 1 else None
        return get_args(only) if get_origin(only) is Literal else ()

    @property
    def placeholder(self) -> str:
        """What stands for its value in help: its choices, a narrow range, or its type."""
        if self.choices:
            return "{" + ",".join(map(str, self.choices)) + "}"
        limits = self.mark(Range)
        if limits is not None and limits.high <= 100:
            return f"{limits.low:g}..{limits.high:g}"
        simple = {int: "N", float: "X", bool: "{True,False}"}.get(self.kinds[0])
        return simple or PLACEHOLDERS.get(self.name, "VALUE")

    def check(self, value: Any, types: tuple[type, ...]) -> None:
        """OptionValueError for a value that the field does not allow. ``types``: those of numbers."""
        fixed, limits = self.mark(Fixed), self.mark(Range)
        if fixed is not None and value != self.default:
            raise OptionValueError(f"``{self.name}`` must be {self.default!r} {fixed.why}")
        if value is None and self.optional:
            return
        if self.choices and value not in self.choices:
            known = ", ".join(map(str, self.choices))
            raise OptionValueError(f"``{self.name}`` must be one of {known}, got {value!r}")
        if bool in self.kinds and not isinstance(value, bool):
            raise OptionValueError(f"``{self.name}`` must be True or False, got {value!r}")
        if limits is not None:
            whole = int in self.kinds
            number = isinstance(value, types) and not isinstance(value, bool)
            if not number or not limits.low <= value <= limits.high or (whole and value % 1 != 0):
                what = "a whole number" if whole else "a number"
                raise OptionValueError(f"``{self.name}`` must be {what} {limits}, got {value!r}")


def of_presets(presets: Mapping[str, object]) -> Callable[[str], str]:
    """Gives the values that ``presets`` have of an option, by its name, where any has one, for help."""

    def values_of(name: str) -> str:
        values = {preset: getattr(options, name) for preset, options in presets.items()}
        known = [f"{preset}: {value}" for preset, value in values.items() if value is not None]
        if len(known) == len(presets) and len(set(values.values())) == 1:
            return f"(default: {next(iter(values.values()))})"
        return f"({'; '.join(known)})" if known else ""

    return values_of


def settings(kind: type) -> dict[str, Setting]:
    """The fields of a dataclass by their names. A field that is declared again keeps the marks of its base
    classes of which it has none of its own."""
    return _declared(kind)


@cache
def _declared(kind: type) -> dict[str, Setting]:
    found = {}
    parts = {part.name: part for part in fields(kind)}
    marks: dict[str, dict[type, Any]] = {name: {} for name in parts}
    hints: dict[str, Any] = {}
    for base in kind.__mro__:
        own = inspect.get_annotations(base)
        for name, hint in get_type_hints(base, include_extras=True).items() if own else ():
            if name not in own or name not in parts or get_origin(hint) is ClassVar:
                continue
            kind_of, *more = get_args(hint) if get_origin(hint) is Annotated else (hint,)
            hints.setdefault(name, kind_of)
            for mark in more:
                marks[name].setdefault(mark if isinstance(mark, type) else type(mark), mark)
    for name, part in parts.items():
        every = alternatives(hints[name])
        inner = tuple(option for option in every if option is not type(None))
        found[name] = Setting(
            name=name,
            kinds=inner,
            optional=type(None) in every,
            default=part.default_factory() if callable(part.default_factory) else part.default,
            marks=tuple(marks[name].values()),
            owner=kind,
        )
    return found


def alternatives(hint: Any) -> tuple[Any, ...]:
    """The types of a union; else the type itself."""
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


@cache
def docstrings(kind: type) -> dict[str, str]:
    """The docstrings of a dataclass' fields and of those of its bases, each in one line: the string under a
    field, which Python itself does not keep."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        source = _classes(base.__module__).get(base.__qualname__)
        for node, text in pairwise(source.body if source else ()):
            if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
                continue
            if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                found[node.target.id] = " ".join(str(text.value.value).split())
    return found


@cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """The classes in the source of a module by their names; none where there is no source. A module is parsed
    once for all of its classes, which takes much of the time of a help text."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError, KeyError):  # made at run time, or built in
        return {}
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


def check_options(
    options: object, *, given: Collection[str] | None = None, types: tuple[type, ...] = NUMBERS
) -> None:
    """Checks a dataclass of options by what its fields declare.

    Args:
        options: the options.
        given: names of those that were set; by default those that differ from their defaults.
        types: accepted types of numbers; bool is never one.

    Raises:
        OptionValueError: a value of the wrong type or out of range.
        OptionsError: one without effect.
    """
    for name, setting in settings(type(options)).items():
        value = getattr(options, name)
        setting.check(value, types)
        condition = setting.mark(With)
        is_given = value != setting.default if given is None else name in given
        if condition is not None and is_given and not condition.met(options):
            got = " and ".join(f"``{other}`` {getattr(options, other)!r}" for other in condition.values)
            but = f", got {got}" if got else ""
            raise OptionsError(f"``{name}`` has no effect without {condition}{but}")


def check_naming(group: type, how: Callable[[str], str]) -> Callable[[Any], None]:
    """``__post_init__`` of the dataclass ``group``, whose errors name options as ``how`` shows them."""

    def check(options: Any) -> None:
        try:
            if (own := getattr(group, "__post_init__", None)) is not None:
                own(options)
        except OptionValueError as error:
            raise type(error)(error.spelled(how)) from None

    return check


def changed(options: Any) -> list[str]:
    """Names of the fields of a dataclass whose values are not their defaults."""
    return [
        name for name, setting in settings(type(options)).items() if getattr(options, name) != setting.default
    ]


def reachable(kind: type) -> dict[str, Setting]:
    """The options of ``kind`` that can be changed: not those that are fixed, nor those for another value of a
    fixed one."""
    every = settings(kind)

    def possible(condition: With) -> bool:
        return any(every[name].mark(Fixed) is None for name in condition.names) or any(
            every[name].mark(Fixed) is None or every[name].default in known
            for name, known in condition.values.items()
        )

    return {
        name: setting
        for name, setting in every.items()
        if setting.mark(Fixed) is None and ((condition := setting.mark(With)) is None or possible(condition))
    }


def did_you_mean(name: str, known: Collection[str]) -> str:
    """A question for messages with the closest of the ``known`` names to ``name``; empty if none is close."""
    close = difflib.get_close_matches(name, known, 1)
    return f"did you mean {close[0]!r}?" if close else ""


def check_names(owner: str, given: Iterable[str], known: Collection[str]) -> None:
    """TypeError for the first of the ``given`` names that is not ``known``, with the closest one that is.

    Args:
        owner: name of the owner of the options, for the message.
    """
    for name in given:
        if name not in known:
            hint = did_you_mean(name, known) or f"options: {', '.join(known)}"
            raise TypeError(f"{owner} has no option {name!r}; {hint}")
