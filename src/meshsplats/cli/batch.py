"""What a conversion reads and writes: one file, several, or all of a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from meshsplats.cli import UsageError, shown_path
from meshsplats.cli.common import check_mesh_suffix, check_outputs, recorded_options
from meshsplats.errors import FileFormatError
from meshsplats.formats.gaussians import splat_file, subject_name
from meshsplats.formats.meshes import MESH_SUFFIXES

INPUT_SUFFIXES = (*MESH_SUFFIXES, ".splat", ".spz", ".sog", ".gltf")
"""Names that are looked at in a folder of inputs."""


@dataclass(frozen=True)
class Job:
    """One input and its outputs."""

    source: Path
    outputs: tuple[Path, ...]
    """The same mesh in several formats."""
    preview: Path | None
    config: Path | None

    @property
    def shown(self) -> str:
        """The input as it was given."""
        return shown_path(self.source)

    def check(self, force: bool) -> None:
        """Before the work: what ``check_outputs`` raises."""
        records = [path for path in (self.preview, self.config) if path is not None]
        check_outputs([*self.outputs, *records], force, inputs=[self.source])


def sources(paths: Sequence[Path]) -> list[Path]:
    """``paths``, with the splats and meshes of folders that are no splats themselves in place of them, by
    name. Raises FileNotFoundError, and FileFormatError for a folder without any."""
    found: list[Path] = []
    for path in paths:
        found += _inside(path) if path.is_dir() else [path]
    return found


def is_batch(paths: Sequence[Path]) -> bool:
    """Whether ``paths`` may stand for more than one input."""
    return len(paths) > 1 or any(path.is_dir() and not _is_splats(path) for path in paths)


def jobs(
    inputs: Sequence[Path], output: Path, formats: Sequence[str], *, preview: bool, sidecars: bool
) -> list[Job]:
    """What each of ``inputs`` becomes. ``formats``: suffixes without a dot, for a folder ``output``; none:
    ``output`` is the one file. UsageError if two would have one name."""
    made: dict[Path, Path] = {}
    result = []
    for source in inputs:
        if formats:
            base = output / subject_name(source)
            outputs = tuple(base.with_name(f"{base.name}.{kind}") for kind in dict.fromkeys(formats))
        else:
            base, outputs = output.with_suffix(""), (output,)
        for path in outputs:
            if path in made:
                raise UsageError(
                    f"{made[path]} and {source} would both become {path}: convert them into different folders"
                )
            made[path] = source
        shown, config = _records(base, outputs)
        kept = sidecars and (shown if preview else None)
        result.append(Job(source, outputs, kept or None, config if sidecars else None))
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
    found = [
        path
        for path in sorted(folder.iterdir())
        if not path.name.startswith(".")
        and (_is_splats(path) if path.is_dir() else path.suffix.lower() in INPUT_SUFFIXES)
    ]
    if not found:
        splat_file(folder)  # says what is wrong
    return found


def _records(base: Path, outputs: Sequence[Path]) -> tuple[Path, Path]:
    """Names of the preview and the configuration. Where the usual ones are those of another mesh, the same in
    another format say, names with all of the output's own."""
    preview, config = record_names(base)
    other = (recorded_options(config) or {}).get("output")
    if isinstance(other, str) and Path(other).name not in [path.name for path in outputs]:
        preview, config = record_names(outputs[0])
    return preview, config


def record_names(name: Path) -> tuple[Path, Path]:
    """Those of the preview and the configuration of the output ``name``, which has no suffix."""
    return name.with_name(f"{name.name}.preview.png"), name.with_name(f"{name.name}.config.json")
