"""Tables of levels of detail: ``levels.json``, as it lies beside the meshes of a chain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from meshsplats._common.choices import Look
from meshsplats._common.json_files import read_json
from meshsplats._common.words import plural
from meshsplats._files.atomic import in_words
from meshsplats.errors import FileFormatError
from meshsplats.rendering.looks import comparison_in_words

TABLE = "levels.json"
_OF_TABLE: dict[str, type | tuple[type, ...]] = {"splats": int, "look": str, "samples": int, "levels": list}
_OF_LEVEL: dict[str, type | tuple[type, ...]] = {
    **{"file": str, "splats": int, "triangles": int, "bytes": int, "screen_size": int, "views": int},
    **{"psnr": (int, float), "seconds": (int, float)},
}
"""Values that every level has, and their types."""


def find_table(path: Path) -> Path | None:
    """The table of the chain ``path``, a folder, or that file itself; None for anything else."""
    file = path / TABLE if path.is_dir() else path
    return file if file.name == TABLE and file.is_file() else None


def load_table(path: Path) -> dict[str, Any]:
    """The table in a file. FileFormatError for a file that holds something else."""
    table = read_json(path)
    rows = table.get("levels") if isinstance(table, dict) else None
    if not rows or not _has(table, _OF_TABLE) or not all(_has(row, _OF_LEVEL) for row in rows):
        raise FileFormatError(f"{path}: not the table of levels of detail that 'meshsplats levels' writes")
    return dict(table)


def _has(values: Any, types: dict[str, type | tuple[type, ...]]) -> bool:
    return isinstance(values, dict) and all(isinstance(values.get(n), kind) for n, kind in types.items())


def table_in_words(table: dict[str, Any]) -> list[str]:
    """Lines with the ``table``: a line of heads, one for each level, and what the scores compare."""
    rows, glb = table["levels"], any(row["file"].endswith(".glb") for row in table["levels"])
    heads = f"{'level':<16}{'splats':>12}{'triangles':>12}{'size':>10}{'pixels':>8}{'dB':>8}{'seconds':>9}"
    lines = [f"{heads}  alpha" if glb else heads]
    for row in rows:
        alpha = row.get("alpha")
        lines.append(
            f"{row['file']:<16}{row['splats']:>12,}{row['triangles']:>12,}{in_words(row['bytes']):>10}"
            f"{row['screen_size']:>8}{row['psnr']:>8.2f}{row['seconds']:>9.1f}"
            + (f"  {alpha['alpha']}" if glb and isinstance(alpha, dict) and "alpha" in alpha else "")
        )
    views = sorted({row["views"] for row in rows})
    count = f"{views[0]} to {views[-1]} views" if len(views) > 1 else plural(views[0], "view")
    look: Look = "splats" if table["look"] == "splats" else "area"
    return [*lines, f"{comparison_in_words(look, table['samples'])}; {count}"]
