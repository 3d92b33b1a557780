"""Inputs and outputs of a conversion: one file, several, or all of a folder."""

from __future__ import annotations

import errno
import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from meshsplats._files.atomic import may_write_in, refuse_existing
from meshsplats._files.locks import lock_of, locked
from meshsplats.errors import DataWarning, FileFormatError, OptionsError, OverwritingError
from meshsplats.formats.mesh_formats import mesh_format_to_write, mesh_suffixes
from meshsplats.formats.outputs import (
    CONFIGURATION,
    PREVIEW,
    beside,
    check_mesh_suffix,
    check_outputs,
    file_of,
    recorded_options,
)
from meshsplats.formats.sniff import archives_of_splats, identify
from meshsplats.formats.splat_formats import splat_suffixes
from meshsplats.formats.splat_paths import files_named, splat_file, subject_name


@dataclass(frozen=True)
class Job:
    """One input and its outputs."""

    source: Path
    outputs: tuple[Path, ...]
    """The same mesh in several formats."""
    preview: Path | None
    configs: tuple[Path, ...]
    """One for each output, or none."""
    shown: str
    """The input as the user named it; - for standard input."""

    @contextmanager
    def claimed(self, force: bool) -> Iterator[None]:
        """Within the block no other process does this job, unless with ``force``. FileExistsError if one is
        at it."""
        first = self.outputs[0]
        if force or not may_write_in(first.absolute().parent):  # reported with the other errors
            yield
            return
        with locked(lock_of(first)) as ours:
            if not ours:
                raise FileExistsError(
                    errno.EEXIST,
                    "another process is writing this output; wait, or give ``force``",
                    str(first),
                )
            yield

    def plan(self, *, force: bool, skip_existing: bool, changes: Callable[[int], str | None]) -> Plan:
        """What is to be written, before the work.

        - A mesh that exists is kept with ``skip_existing``; without, only if this very command has made it
          and was interrupted.
        - Where the mesh is missing, records of it must be of this very command.
        - All that is missing is made, but for the preview of a mesh that may be of another command.

        Args:
            force: write everything.
            skip_existing: see above.
            changes: for the index of an output, how the options on record differ from those of now: empty if
                they do not, None without a record.

        Raises:
            OSError: an output exists already, or cannot be written.
            OverwritingError: an output is the input.
        """
        preview = [self.preview] if self.preview else []
        every = [*self.outputs, *self.configs, *preview]
        check_outputs(every, force=True, inputs=[self.source])
        there = [] if force else [path for path in every if os.path.lexists(path)]
        if not there:
            refuse_existing(every, force)
            return Plan(self)
        old = [
            _Old(path, path in there, changes(i), self._other_input(path) if path in there else "")
            for i, path in enumerate(self.outputs)
        ]
        in_the_way = [mesh.path for mesh in old if mesh.there and not (skip_existing or mesh.ours)]
        in_the_way += [
            config
            for config, mesh in zip(self.configs, old, strict=False)
            if config in there and not (mesh.there or mesh.ours)
        ]
        in_the_way += [image for image in preview if image in there and not (old[0].there or old[0].ours)]
        missing = [i for i, mesh in enumerate(old) if not mesh.there]
        image = self.preview if self.preview not in there and (0 in missing or old[0].ours) else None
        if not (missing or image or skip_existing):
            in_the_way = there  # complete
        if in_the_way:
            raise _taken(in_the_way, next((mesh.doubt for mesh in old if mesh.doubt), ""))
        configs = [self.configs[i] for i in missing] if self.configs else []
        left = replace(
            self, outputs=tuple(self.outputs[i] for i in missing), preview=image, configs=tuple(configs)
        )
        refuse_existing([path for path in (*left.outputs, *configs, *preview) if path not in there], False)
        return Plan(left, tuple(mesh for mesh in old if mesh.there))

    def _other_input(self, output: Path) -> str:
        """Why ``output``, which exists, may have been made from another input; empty if nothing tells so."""
        if self.shown == "-":
            return "perhaps made from another standard input"
        return "older than its input" if output.stat().st_mtime < file_of(self.source).stat().st_mtime else ""


@dataclass(frozen=True)
class _Old:
    """A mesh of an earlier run, or its records alone."""

    path: Path
    there: bool
    changes: str | None
    """How its options on record differ from those of now: empty if they do not, None without a record."""
    other_input: str = ""
    """Why it may have been made from another input; empty if nothing tells so."""

    @property
    def ours(self) -> bool:
        """Whether this very command would make it again."""
        return self.changes == "" and not self.other_input

    @property
    def doubt(self) -> str:
        """Why it may not be what this command would make; empty if nothing tells so."""
        options = f"made with other options: {self.changes}" if self.changes else ""
        return " and ".join(filter(None, (self.other_input, options)))

    @property
    def remark(self) -> str:
        """The warning of a command that keeps it; empty if none is due."""
        return f"{self.path}: kept, though {self.doubt}; ``force`` makes it anew" if self.doubt else ""


@dataclass(frozen=True)
class Plan:
    """What is left of a job."""

    job: Job
    """With the outputs, preview and configurations that are to be written."""
    kept: tuple[_Old, ...] = ()
    """The meshes that are there and stay."""

    @property
    def finished(self) -> bool:
        """Whether there is nothing to do."""
        return not self.job.outputs and self.job.preview is None


def _taken(paths: Sequence[Path], doubt: str) -> FileExistsError:
    more = f" (and {len(paths) - 1} more)" if len(paths) > 1 else ""
    how = f", {doubt}" if doubt else ""
    ways = "``force`` overwrites it, ``skip_existing`` makes only the meshes that are missing"
    return FileExistsError(errno.EEXIST, f"the output exists already{more}{how}; {ways}", str(paths[0]))


def sources(paths: Sequence[Path]) -> list[Path]:
    """``paths``, with the splats and meshes inside in place of a folder that is no model, by name: of models,
    files, links that lead nowhere, pipes and zip archives of splats. A DataWarning tells of other folders
    that are named as files. Raises FileNotFoundError, and FileFormatError for a folder without any."""
    found: list[Path] = []
    for path in paths:
        some = _inside(path) if path.is_dir() else [path]
        for inner in sorted(path.glob("[!.]*")) if path not in some else ():
            if inner.is_dir() and inner.name.lower().endswith(_suffixes()) and inner not in some:
                text = f"{inner}: a folder, and no model: passed over; name it to take what is in it"
                warnings.warn(text, DataWarning, stacklevel=2)
        found += some
    return found


def is_batch(paths: Sequence[Path]) -> bool:
    """Whether ``paths`` may name more than one input. FileFormatError for a folder without any."""
    folders = [path for path in paths if path.is_dir() and not _is_splats(path)]
    return any([_inside(folder) for folder in folders]) or len(paths) > 1


def formats_of(output: Path, formats: Sequence[str], *, folder: bool, as_splats: bool) -> Sequence[str]:
    """Suffixes to write in the ``folder`` ``output``, without a dot, those that are given or the usual one;
    none for a single file. OptionsError for a name that does not fit."""
    if folder:
        if mesh_format_to_write(output) is not None and not output.is_dir():
            where = f"``output`` {output.with_suffix('')}"
            raise OptionsError(f"several inputs or formats need a folder: {where}, say")
        return formats or (("ply",) if as_splats else ("glb",))
    if not as_splats:
        check_mesh_suffix(output, "; for a folder, name the formats: ``formats`` glb")
    return ()


def jobs(
    inputs: Sequence[Path],
    output: Path,
    formats: Sequence[str],
    *,
    preview: bool,
    sidecars: bool,
    shown: Callable[[Path], str] = str,
) -> list[Job]:
    """A job for each of ``inputs``. ``formats``: suffixes without a dot, for a folder ``output``; none:
    ``output`` is the one file. ``shown``: an input as the user named it.

    Files in a folder are named like their inputs, ``a.glb`` for ``a.ply``; but ``a.ply.glb`` and
    ``a.sog.glb`` for ``a.ply`` and ``a.sog``. OverwritingError if two outputs have one name all the same.
    """
    made: dict[Path, Path] = {}
    result = []
    named = _names(inputs) if formats else [""] * len(inputs)
    for source, name in zip(inputs, named, strict=True):
        outputs = tuple(output / f"{name}.{kind}" for kind in dict.fromkeys(formats)) or (output,)
        for path in outputs:
            if path in made:
                raise OverwritingError(
                    f"{made[path]} and {source} would both become {path}: convert them into different folders"
                )
            made[path] = source
        image = beside(outputs[0], PREVIEW) if sidecars and preview else None
        configs = tuple(beside(path, CONFIGURATION) for path in outputs) if sidecars else ()
        result.append(Job(source, outputs, image, configs, shown(source)))
    return result


def _names(inputs: Sequence[Path]) -> list[str]:
    """A name for each of ``inputs``: ``subject_name``, with the ending of the file where several have one
    name, be it in letters of another case, which not all systems tell apart."""
    whole: set[int] = set()
    while True:
        names = [subject_name(path, ending=i in whole) for i, path in enumerate(inputs)]
        count = Counter(map(str.casefold, names))
        alike = {i for i, name in enumerate(names) if count[name.casefold()] > 1} - whole
        if not alike:
            return names
        archives = {i for i in alike if inputs[i].suffix.lower() == ".zip"}
        whole |= archives or alike  # a.glb of a.ply keeps its name beside that of a.zip


def without_results(
    inputs: Sequence[Path], named: Sequence[Path], output: Path, formats: Sequence[str]
) -> list[Path]:
    """``inputs`` without the results of an earlier conversion of the others into the folder ``output``, where
    that is the inputs' own folder, too. Those that were ``named`` stay."""
    if not output.is_dir():
        return list(inputs)
    here = [path for path in inputs if path not in named and path.absolute().parent.samefile(output)]
    results: set[Path] = set()
    for path in here:
        others = [other for other in here if other != path and other not in results]
        names = {subject_name(other, ending=whole) for other in others for whole in (False, True)}
        if any(path.name == f"{name}.{kind}" for name in names for kind in formats) and _is_result(path):
            results.add(path)
    return [path for path in inputs if path not in results]


def _is_result(path: Path) -> bool:
    """Whether ``path`` can have been made by convert."""
    if recorded_options(beside(path, CONFIGURATION), "convert") is not None:
        return True
    try:
        return not path.is_dir() and identify(path) == "mesh"
    except (FileFormatError, OSError):
        return False


def _is_splats(folder: Path) -> bool:
    try:
        splat_file(folder)
    except FileFormatError:
        return False
    return True


def _suffixes() -> tuple[str, ...]:
    return (*mesh_suffixes(), *splat_suffixes())


def _inside(folder: Path) -> list[Path]:
    if _is_splats(folder):
        return [folder]
    models = [
        path
        for path in folder.iterdir()
        if path.is_dir() and not path.name.startswith(".") and _is_splats(path)
    ]
    files = files_named(folder, _suffixes())
    found = sorted([*models, *files, *archives_of_splats(folder)])
    if not found:
        splat_file(folder)  # says what is wrong
    return found
