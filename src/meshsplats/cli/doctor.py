"""``meshsplats doctor``: installed libraries, and missing ones."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from meshsplats.cli.arguments import Command
from meshsplats.cli.messages import quoted
from meshsplats.installation import examine


@dataclass(frozen=True)
class Doctor(Command):
    """Lists installed and missing libraries, the instruction set in use and the GPU. Exit code 1 if rendering
    on the CPU fails."""

    json: bool = False
    """Print the findings as JSON."""

    def execute(self) -> int:
        findings = examine()
        missing = findings["to_install"].items()
        findings["to_install"] = {extra: " ".join(map(quoted, names)) for extra, names in missing}
        if self.json:
            print(json.dumps(findings, indent=1))
        else:
            print(_text(findings))
        return 0 if findings["core"]["works"] else 1


def _text(findings: dict[str, Any]) -> str:
    core = findings["core"]
    lines = [
        f"MeshSplats {findings['meshsplats']}, Python {findings['python']}, {findings['platform']}",
        f"threads: {findings['threads']}",
    ]
    if core["works"]:
        lines.append(
            f"core: {core['in_use']} in use; runs here: {', '.join(core['available'])}; renders correctly"
        )
    else:
        lines.append(f"core: DOES NOT WORK: {core['problem']}")
    gpu = findings["gpu"]
    state = "renders and differentiates correctly" if gpu["works"] else gpu["problem"]
    lines.append("gpu: " + "; ".join(filter(None, (gpu["adapter"], state))))
    drawing = ", ".join(findings["harmonics_drawn_by"]) or "nothing"
    lines.append(f"colours that depend on the view: drawn by {drawing}; other programs show plain ones")
    lines.append("libraries: " + _listed(findings["required"]))
    for extra, libraries in findings["extras"].items():
        missing = findings["to_install"].get(extra)
        advice = f"; to install: pip install {missing}" if missing else ""
        if missing and extra == "blender":
            where = "in an environment of its own with Python 3.11 or 3.13"
            advice = f"; to install, {where}: pip install {missing}"
        lines.append(f"extra {extra!r}: {_listed(libraries)}{advice}")
    return "\n".join(lines)


def _listed(libraries: dict[str, str | None]) -> str:
    return ", ".join(f"{name} {version or 'MISSING'}" for name, version in libraries.items()) or "unknown"
