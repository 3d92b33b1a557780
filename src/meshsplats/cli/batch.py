"""Inputs and outputs of a conversion: one file, several, or all of a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from meshsplats.cli.common import check_mesh_suffix, check_outputs
from meshsplats.cli.messages import UsageError, shown_path
from meshsplats.cli.records import CONFIGURATION, PREVIEW, beside
from meshsplats.errors import FileFormatError
from meshsplats.formats.gaussians import SPLAT_SUFFIXES, files_named, splat_file, subject_name
from meshsplats.formats.meshes import MESH_SUFFIXES

INPUT_SUFFIXES = (*MESH_SUFFIXES, *SPLAT_SUFFIXES)
"""Names of inputs in a folder."""


@dataclass(frozen=True)
class Job:
    """One input and its outputs."""

    source: Path
    outputs: tuple[Path, ...]
    """The same mesh in several formats."""
    preview: Path | None
    configs: tuple[Path, ...]
    """One for each output, or none."""

    @property
    def shown(self) -> str:
        """The input as the user named it."""
        return shown_path(self.source)

    def check(self, force: bool) -> None:
        """Before the work: the errors of ``check_outputs``."""
        records = [*self.configs, *([self.preview] if self.preview else [])]
        check_outputs([*self.outputs, *records], force, inputs=[self.source])


def sources(paths: Sequence[Path]) -> list[Path]:
    """``paths``, with the splats and meshes inside in place of a folder that is no model, by name. Raises
    FileNotFoundError, and FileFormatError for a folder without any."""
    found: list[Path] = []
    for path in paths:
        found += _inside(path) if path.is_dir() else [path]
    return found


def is_batch(paths: Sequence[Path]) -> bool:
    """Whether ``paths`` may name more than one input."""
    return len(paths) > 1 or any(path.is_dir() and not _is_splats(path) for path in paths)


def jobs(
    inputs: Sequence[Path], output: Path, formats: Sequence[str], *, preview: bool, sidecars: bool
) -> list[Job]:
    """A job for each of ``inputs``. ``formats``: suffixes without a dot, for a folder ``output``; none:
    ``output`` is the one file. UsageError if two outputs have one name."""
    made: dict[Path, Path] = {}
    result = []
    for source in inputs:
        if formats:
            base = output / subject_name(source)
            outputs = tuple(base.with_name(f"{base.name}.{kind}") for kind in dict.fromkeys(formats))
        else:
            outputs = (output,)
        for path in outputs:
            if path in made:
                raise UsageError(
                    f"{made[path]} and {source} would both become {path}: convert them into different folders"
                )
            made[path] = source
        image = beside(outputs[0], PREVIEW) if sidecars and preview else None
        configs = tuple(beside(path, CONFIGURATION) for path in outputs) if sidecars else ()
        result.append(Job(source, outputs, image, configs))
    return result


def check_folder(output: Path) -> None:
    """UsageError if ``output`` names a mesh file, where a folder for several is wanted."""
    if output.suffix.lower() in MESH_SUFFIXES and not output.is_dir():
        raise UsageError(f"several inputs or formats need a folder: -o {output.with_suffix('')}, say")


def check_file(output: Path) -> None:
    """UsageError if no mesh can be written as ``output``."""
    try:
        check_mesh_suffix(output)
    except UsageError as error:
        raise UsageError(f"{error}; for a folder, name the formats: --formats glb") from None


def _is_splats(folder: Path) -> bool:
    try:
        splat_file(folder)
    except FileFormatError:
        return False
    return True


def _inside(folder: Path) -> list[Path]:
    if _is_splats(folder):
        return [folder]
    models = [
        path
        for path in folder.iterdir()
        if path.is_dir() and not path.name.startswith(".") and _is_splats(path)
    ]
    found = sorted([*models, *files_named(folder, INPUT_SUFFIXES)])
    if not found:
        splat_file(folder)  # says what is wrong
    return found
