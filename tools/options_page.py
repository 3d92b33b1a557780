"""Writes docs/options.md: what the options of conversion, fine-tuning and training declare.

    .venv/bin/python tools/options_page.py

tests/common/test_option_fields.py fails where the page is older than the options.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from meshsplats._common.options import Range, Setting, reachable, settings
from meshsplats.cli import COMMANDS
from meshsplats.cli.arguments import options_of
from meshsplats.cli.messages import flag
from meshsplats.conversion.options import PRESETS as CONVERSIONS
from meshsplats.conversion.options import ConversionOptions
from meshsplats.finetuning.config import PRESETS as TUNINGS
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.training.config import TrainConfig

PAGE = Path(__file__).resolve().parents[1] / "docs" / "options.md"
INTRODUCTION = """# Options

<!-- Made by tools/options_page.py from the options' fields. -->

`--help-all` shows the options that have a flag; the others are set by name. In Python all are keywords, in
configuration files lines, with the same checks:

```sh
meshsplats finetune scene.ply -o tuned.npz --minutes 5 --set ssim_weight=0.6 --set sides=6
```

```python
import meshsplats as ms

config = ms.make_config(minutes=5, ssim_weight=0.6)
mesh = ms.convert(ms.load_gaussians("scene.ply"), sides=6)
```

Lists have commas: `--set "crop=-1,-1,-1,1,1,1"`, in quotes for PowerShell. Where a default is empty, in
Python None, the text names it, or there is none.
"""


def page() -> str:
    """The whole page."""
    tuning = {name: s for name, s in settings(FinetuneConfig).items() if name != "preset"}
    training = {n: s for n, s in reachable(TrainConfig).items() if n not in tuning or _differs(s, tuning[n])}
    training.pop("preset")
    sections = [
        INTRODUCTION,
        "## Conversion\n\n`convert` and `finetune`, where splats are converted first.\n",
        *_table(_rows(settings(ConversionOptions), "convert", CONVERSIONS), ("default", "paper")),
        "\n## Fine-tuning\n\n`finetune`, and with few other defaults `prior`.\n",
        *_table(_rows(tuning, "finetune", TUNINGS), ("default", "paper")),
        "\n## Training\n\n`train`: its own options, and those of fine-tuning with another default.\n",
        *_table(_rows(training, "train", {"default": TrainConfig()}), ("default",)),
        "\n## Other options without a flag\n",
        *_table(_others(), ("default",), "commands"),
    ]
    return "\n".join(sections) + "\n"


def _differs(one: Setting, other: Setting) -> bool:
    return (one.default, one.help) != (other.default, other.help)


def _rows(known: dict[str, Setting], command: str, presets: dict[str, Any]) -> Iterator[list[str]]:
    """Name, values, defaults and help of each option."""
    options = options_of(_command(command))
    for name, setting in known.items():
        shown = flag(name) if options[name].has_flag else name
        defaults = [_shown(getattr(preset, name)) for preset in presets.values()]
        yield [f"`{shown}`", _values(setting), *defaults, _plain(setting.text)]


def _others() -> Iterator[list[str]]:
    """The options without a flag that belong to commands alone."""
    elsewhere = {
        (name, setting.help)
        for kind in (ConversionOptions, FinetuneConfig, TrainConfig)
        for name, setting in settings(kind).items()
    }
    found: dict[str, tuple[list[str], Setting]] = {}
    for command in COMMANDS:
        kind = _command(command)
        for name, option in options_of(kind).items():
            setting = _setting(kind, option.path)
            if not option.has_flag and (name, setting.help) not in elsewhere:
                found.setdefault(name, ([], setting))[0].append(command)
    for name, (commands, setting) in found.items():
        values, default = _values(setting), _shown(setting.default)
        yield [f"`{name}`", ", ".join(commands), values, default, _plain(setting.text)]


def _setting(kind: type, path: tuple[str, ...]) -> Setting:
    for group in path[:-1]:
        kind = settings(kind)[group].kinds[0]
    library = next((base for base in kind.__mro__[1:] if base.__name__ == kind.__name__), kind)
    return settings(library)[path[-1]]  # which has the default


def _command(name: str) -> type:
    module, _, attribute = COMMANDS[name][0].partition(":")
    return getattr(importlib.import_module(module), attribute)


def _values(setting: Setting) -> str:
    limits = setting.mark(Range)
    if setting.choices:
        return ", ".join(map(str, setting.choices))
    if limits is not None:
        return str(limits).removeprefix("from ").removeprefix("of ")
    return "True, False" if bool in setting.kinds else ""


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(_shown, value))
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _plain(text: str) -> str:
    return re.sub("``(.+?)``", r"`\1`", text).replace("|", r"\|")


def _table(rows: Iterable[list[str]], defaults: tuple[str, ...], more: str = "") -> list[str]:
    titles = ["option", *([more] if more else []), "values", *defaults, ""]
    return [f"| {' | '.join(row)} |" for row in (titles, ["---"] * len(titles), *rows)]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8", newline="\n")
