"""``meshsplats doctor``: installed libraries, and missing ones."""

from __future__ import annotations

from dataclasses import dataclass

from meshsplats._common.words import quoted
from meshsplats.cli.arguments import Command


@dataclass(frozen=True)
class Doctor(Command):
    """Lists installed and missing libraries, the instruction set in use and the GPU. Exit code 1 if rendering
    on the CPU fails."""

    json: bool = False
    """Print the findings as JSON."""

    def execute(self) -> int:
        from meshsplats.operations.installation import examine, in_words

        findings = examine()
        missing = findings["to_install"].items()
        findings["to_install"] = {extra: " ".join(map(quoted, names)) for extra, names in missing}
        self.finish(findings, *in_words(findings))
        return 0 if findings["core"]["works"] else 1
