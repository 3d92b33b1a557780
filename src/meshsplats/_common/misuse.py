"""What is wrong with the words of a command line, said in one line."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from meshsplats._common.option_values import converted, from_text, short
from meshsplats._common.options import alternatives, did_you_mean

_MANY = 10**9


@dataclass(frozen=True)
class Usage:
    """The words that a command takes."""

    kinds: Mapping[str, Any]
    """Type of each flag, by its name such as ``--steps``, and of each word without a flag, by a name without
    dashes, in their order. bool: a flag without a value; a tuple without end: all words that follow."""
    required: Collection[str]
    """Names of those that cannot be left out."""
    letters: Mapping[str, str] = field(default_factory=dict)
    """Flags by their short forms, such as ``-o``."""
    negatable: bool = False
    """Whether ``--no-FLAG`` clears a flag without a value."""

    @property
    def places(self) -> list[str]:
        """Names of words without a flag."""
        return [name for name in self.kinds if name[0] != "-"]


def misuse(words: Sequence[str], usage: Usage) -> str:
    """What is wrong with ``words``; empty where nothing is found."""
    waiting, plain, given = [_in_full(word, usage) for word in words], [], set()
    runs: list[str] = []
    after_flag = True
    while waiting:
        word = waiting.pop(0)
        if not _is_flag(word):
            plain.append(word)
            runs += [word] if after_flag else []
            after_flag = False
            continue
        after_flag = True
        name, equals, value = _name_of(word), *word.partition("=")[1:]
        if (kind := usage.kinds.get(name)) is None:
            positive = _positive(name)
            if name != positive and usage.kinds.get(positive) is bool:
                if usage.negatable:
                    continue
                return f"there is no option {name}: leave {positive} out"
            hint = did_you_mean(name, usage.kinds)
            return f"there is no option {short(name)[1:-1]}" + (f"; {hint}" if hint else "")
        given.add(name)
        if kind is bool:
            if equals:
                return f"{name} takes no value, got {short(value)}"
            continue
        values = [value] if equals else []
        while waiting and len(values) < _most(kind, values) and not _is_flag(waiting[0]):
            values.append(waiting.pop(0))
        if problem := _problem(kind, values):
            if not values and waiting and _may_begin_with_dash(kind) and not _is_known(waiting[0], usage):
                problem += f"; one that begins with - is written {name}={waiting[0]}"
            return f"{name} {problem}"
    return _of_places(plain, runs, given, usage)


def _in_full(word: str, usage: Usage) -> str:
    """``word`` with the whole flag in place of a short one: ``-o=x`` and ``-ox`` are ``--output=x``."""
    letter, rest = word[:2], word[2:]
    if letter not in usage.letters or "-" + _name_of(word) in usage.kinds:  # -orbit lacks a dash
        return word
    return usage.letters[letter] + (f"={rest.removeprefix('=')}" if rest else "")


def _name_of(word: str) -> str:
    """The flag that ``word`` begins with."""
    return word.partition("=")[0].replace("_", "-")


def _positive(name: str) -> str:
    """The flag that ``name`` clears, where it begins with no-; else the flag itself, with two dashes."""
    return "--" + name.removeprefix("--").removeprefix("no-")


def _is_known(word: str, usage: Usage) -> bool:
    """Whether ``word`` is an option, or meant as one."""
    name = _name_of(word)
    return name in usage.kinds or _positive(name) in usage.kinds or word[:2] == "--"


def _may_begin_with_dash(kind: Any) -> bool:
    return any(each in (str, Path) for each in alternatives(kind))


def _is_flag(word: str) -> bool:
    with suppress(ValueError):
        float(word)
        return False
    return len(word) > 1 and word[0] == "-" and not re.match(r"-[\d.]", word)  # -1,2,3 is a value


def _most(kind: Any, values: Sequence[str]) -> int:
    """Most values of an option that begin with these."""
    most = 1
    for each in alternatives(kind):
        if values and get_origin(each) is Literal and values[0] in get_args(each):
            return 1
        if get_origin(each) is tuple:
            most = _MANY if Ellipsis in get_args(each) else len(get_args(each))
    return most


def _problem(kind: Any, values: Sequence[str]) -> str:
    """What is wrong with these values of an option, for its name in front; empty if nothing is."""
    if not values:
        return f"needs {_wanted(kind)}"
    kinds = [each for each in alternatives(kind) if each is not type(None)]
    lists = [each for each in kinds if get_origin(each) is tuple]
    others = [each for each in kinds if each not in lists]
    if not lists or (others and not _of_value(others[0], values[0])):
        return _of_value(kind, values[0])
    parts = get_args(lists[0])
    if Ellipsis in parts:
        parts = (parts[0],) * len(values)
    if len(values) != len(parts):
        return f"needs {_wanted(kind)}, got {short(' '.join(values))}"
    return next(filter(None, map(_of_value, parts, values)), "")


def _of_value(kind: Any, text: str) -> str:
    try:
        converted(from_text(text, kind), kind, Path())
    except TypeError as error:
        number = re.match(r"-?\d+" if float not in alternatives(kind) else r"-?\d+(\.\d+)?", text)
        such_as = f", such as {number[0]}" if number and "number" in str(error) else ""
        return f"must be {error}{such_as}, got {short(text)}"
    return ""


def _wanted(kind: Any) -> str:
    """What an option of this type takes, in words."""
    wanted = []
    for each in alternatives(kind):
        if get_origin(each) is tuple:
            count = len(get_args(each))
            wanted.append("values" if Ellipsis in get_args(each) else f"{count} values")
        elif each is not type(None):
            try:
                converted(None, each, Path())
            except TypeError as error:
                wanted.append(str(error))
    return " or ".join(wanted)


def _of_places(plain: Sequence[str], runs: Sequence[str], given: Collection[str], usage: Usage) -> str:
    """What is wrong with the words without a flag, or missing, where the flags ``given`` are. ``runs``: the
    first word of each sequence of ``plain`` words that flags do not part."""
    from meshsplats._common.foreign import IMAGE_SUFFIXES  # loads the module of zip archives

    endless = any(_most(usage.kinds[name], ()) == _MANY for name in usage.places)
    if len(plain) > len(usage.places) and not endless:
        if all(word.lower().endswith(IMAGE_SUFFIXES) for word in plain):
            return "give the folder of the photographs, not the photographs themselves"
        word = plain[len(usage.places)]
        return f"unexpected argument {short(word)}{_of_numbers(word)}"
    if endless and len(runs) > 1:
        advice = _of_numbers(runs[1]) or ": give all inputs before the options"
        return f"{short(runs[1])} comes after an option{advice}"
    found = {*given, *usage.places[: len(plain)]}
    missing = [name if name[0] == "-" else f"the {name}" for name in usage.required if name not in found]
    if not missing:
        return ""
    return f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"


def _of_numbers(word: str) -> str:
    """Advice where ``word`` is a number: PowerShell makes several words of 1,2,3."""
    with suppress(ValueError):
        float(word)
        return '; numbers with commas are one word, in quotes in PowerShell: "1,2,3"'
    return ""


def in_one_line(text: str) -> str:
    """A message in a box of lines as one line, without its reference to help."""
    said = re.split("for full helptext", text, maxsplit=1, flags=re.IGNORECASE)[0]
    # The title of the box is in its first line; where the terminal has no lines, they are of dashes.
    inner = re.split("\u256e|-{5,}", said, maxsplit=1)[-1]
    words = re.sub("[\u2500-\u257f]+|-{5,}", " ", inner)
    return " ".join(words.split()) or "the options were not understood"
