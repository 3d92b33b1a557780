"""An independent writer of PLY files in every layout, row by row, and random splats to put in them."""

from __future__ import annotations

import struct

import numpy as np

CODES = {
    "char": "b",
    "uchar": "B",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
}


class Table:
    """One element: ``columns`` are (type, name), or (count type, item type, name) of a list."""

    def __init__(self, name, columns, rows):
        self.name, self.columns, self.rows = name, columns, rows


def write_ply(path, tables, encoding="binary_little_endian", end="\n", comments=(), tail=b""):
    """Writes ``tables`` in one of the three encodings, with any line end."""
    lines = ["ply", f"format {encoding} 1.0", *[f"comment {c}" for c in comments]]
    for t in tables:
        lines.append(f"element {t.name} {len(t.rows)}")
        for column in t.columns:
            lines.append(f"property {'list ' if len(column) == 3 else ''}{' '.join(column)}")
    data = (end.join([*lines, "end_header"]) + end).encode()
    order = ">" if encoding == "binary_big_endian" else "<"
    for t in tables:
        for row in t.rows:
            if encoding == "ascii":
                flat = []
                for column, value in zip(t.columns, row, strict=True):
                    flat += [len(value), *value] if len(column) == 3 else [value]
                data += (
                    " ".join(repr(float(v)) if isinstance(v, float) else str(v) for v in flat) + end
                ).encode()
                continue
            for column, value in zip(t.columns, row, strict=True):
                if len(column) == 3:
                    data += struct.pack(order + CODES[column[0]], len(value))
                    data += struct.pack(f"{order}{len(value)}{CODES[column[1]]}", *value)
                else:
                    data += struct.pack(order + CODES[column[0]], value)
    path.write_bytes(data + tail)
    return path


def random_splats(n=7, degree=3, seed=0):
    """Stored values by property name, in float32 steps so that every numeric type keeps them."""
    rng = np.random.default_rng(seed)
    k = (degree + 1) ** 2
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    values = {name: rng.normal(size=n).astype(np.float32) for name in names}
    for i in range(3):
        values[f"scale_{i}"] -= 4
    return values


def splat_table(values, types=None, name="vertex"):
    """``values`` as an element; ``types`` gives other types than float by property name."""
    types = types or {}
    columns = [(types.get(key, "float"), key) for key in values]
    whole = [types.get(key, "float") not in ("float", "double") for key in values]
    arrays = list(values.values())
    rows = [
        [int(a[i]) if w else float(a[i]) for a, w in zip(arrays, whole, strict=True)]
        for i in range(len(arrays[0]))
    ]
    return Table(name, columns, rows)


def expected_cloud(values):
    """The physical values that a splat file of ``values`` means, in float64, written out splat by splat."""
    n = len(values["x"])
    rest = sum(key.startswith("f_rest_") for key in values) // 3
    out = {"means": [], "quaternions": [], "scales": [], "opacities": [], "sh": []}
    for i in range(n):
        v = {key: float(a[i]) for key, a in values.items()}
        q = np.array([v[f"rot_{j}"] for j in range(4)])
        out["means"].append([v["x"], v["y"], v["z"]])
        out["quaternions"].append(q / np.linalg.norm(q))
        out["scales"].append([np.exp(v[f"scale_{j}"]) if f"scale_{j}" in v else 0 for j in range(3)])
        out["opacities"].append(1 / (1 + np.exp(-v["opacity"])))
        sh = [[v[f"f_dc_{c}"] for c in range(3)]]
        sh += [[v[f"f_rest_{c * rest + j}"] for c in range(3)] for j in range(rest)]
        out["sh"].append(sh)
    return {key: np.array(value) for key, value in out.items()}


def assert_same_cloud(cloud, expected, tolerance=1e-6):
    """``cloud`` holds the values of ``expected_cloud`` to a relative ``tolerance`` of float32 size."""
    for name, value in expected.items():
        np.testing.assert_allclose(
            getattr(cloud, name), value, rtol=tolerance, atol=tolerance * 1e-3, err_msg=name
        )
