"""Splat files of every compressed format, encoded splat by splat as their specifications say."""

from __future__ import annotations

import base64
import gzip
import io
import json
import struct
import zipfile

import numpy as np
from PIL import Image

C0 = 0.28209479177387814


def unit_quaternion(values, i):
    q = np.array([float(values[f"rot_{j}"][i]) for j in range(4)])
    return q / np.linalg.norm(q)


def rest(values, i):
    """(k - 1, 3) harmonics of splat i beyond the first."""
    n = sum(key.startswith("f_rest_") for key in values) // 3
    return np.array([[float(values[f"f_rest_{c * n + j}"][i]) for c in range(3)] for j in range(n)])


def byte(x):
    return int(np.clip(round(x), 0, 255))


def sigmoid(x):
    return 1 / (1 + np.exp(-float(x)))


def smallest_three(q):
    """Index of the largest component and the other three, the largest made positive."""
    largest = int(np.argmax(np.abs(q)))
    q = q if q[largest] >= 0 else -q
    return largest, [q[j] for j in range(4) if j != largest]


# -- PlayCanvas compressed .ply


def compressed_ply(values, order="little", colors=True, comments=()):
    n = len(values["x"])
    chunks, vertices, harmonics = b"", b"", b""
    fmt = "<" if order == "little" else ">"
    groups = [("x", "y", "z"), ("scale_0", "scale_1", "scale_2")]
    rgb = [np.array([float(values[f"f_dc_{c}"][i]) * C0 + 0.5 for i in range(n)]) for c in range(3)]
    for first in range(0, n, 256):
        part = range(first, min(first + 256, n))
        limits = []
        for group in groups:
            columns = [values[key][part.start : part.stop].astype(float) for key in group]
            limits += [(c.min(), c.max()) for c in columns]
        limits += [(c[part.start : part.stop].min(), c[part.start : part.stop].max()) for c in rgb]
        floats = []
        for g in range(3 if colors else 2):
            floats += [low for low, _ in limits[3 * g : 3 * g + 3]] + [
                high for _, high in limits[3 * g : 3 * g + 3]
            ]
        chunks += struct.pack(f"{fmt}{len(floats)}f", *floats)

        def packed(x, limit, bits):
            span = limit[1] - limit[0]
            return round((x - limit[0]) / span * ((1 << bits) - 1)) if span else 0

        for i in part:
            words = []
            for g, group in enumerate(groups):
                a, b, c = (
                    packed(float(values[group[k]][i]), limits[3 * g + k], (11, 10, 11)[k]) for k in range(3)
                )
                words.append(a << 21 | b << 11 | c)
            largest, others = smallest_three(unit_quaternion(values, i))
            turn = largest
            for x in others:
                turn = turn << 10 | round((x / np.sqrt(2) + 0.5) * 1023)
            words.insert(1, turn)
            color = 0
            for c in range(3):
                color = color << 8 | (
                    packed(rgb[c][i], limits[6 + c], 8) if colors else byte(255 * rgb[c][i])
                )
            words.append(color << 8 | byte(255 * sigmoid(values["opacity"][i])))
            vertices += struct.pack(f"{fmt}4I", *words)
            for x in rest(values, i).T.ravel():
                harmonics += bytes([int(np.clip((x / 8 + 0.5) * 256, 0, 255))])
    lines = ["ply", f"format binary_{order}_endian 1.0", *[f"comment {c}" for c in comments]]
    lines.append(f"element chunk {-(-n // 256)}")
    for group in ("", "scale_"):
        lines += [f"property float {end}_{group}{axis}" for end in ("min", "max") for axis in "xyz"]
    if colors:
        lines += [f"property float {end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    lines.append(f"element vertex {n}")
    lines += [f"property uint packed_{what}" for what in ("position", "rotation", "scale", "color")]
    if harmonics:
        lines.append(f"element sh {n}")
        lines += [f"property uchar f_rest_{i}" for i in range(len(harmonics) // n)]
    return "\n".join([*lines, "end_header", ""]).encode() + chunks + vertices + harmonics


# -- .splat


def dot_splat(values):
    data = b""
    for i in range(len(values["x"])):
        data += struct.pack("<3f", *(values[key][i] for key in "xyz"))
        data += struct.pack("<3f", *(np.exp(float(values[f"scale_{k}"][i])) for k in range(3)))
        data += bytes(byte(255 * (0.5 + C0 * float(values[f"f_dc_{c}"][i]))) for c in range(3))
        data += bytes([byte(255 * sigmoid(values["opacity"][i]))])
        data += bytes(int(np.clip(128 + 128 * x, 0, 255)) for x in unit_quaternion(values, i))
    return data


# -- .ksplat


def ksplat(values, level=1, capacity=4, block=5.0, sections=1, limits=(-2.0, 2.0)):
    """As the viewer GaussianSplats3D saves them: buckets of splats that lie in one cell of side ``block``,
    those that are full first."""
    n = len(values["x"])
    bands = {0: 0, 9: 1, 24: 2, 45: 3}[sum(key.startswith("f_rest_") for key in values)]
    heads, bodies = b"", b""
    for part in np.array_split(np.arange(n), sections):
        cells = {}
        for i in part:
            cells.setdefault(tuple(int(np.floor(float(values[k][i]) / block)) for k in "xyz"), []).append(i)
        buckets = [
            (cell, members[first : first + capacity])
            for cell, members in cells.items()
            for first in range(0, len(members), capacity)
        ]
        buckets.sort(key=lambda bucket: len(bucket[1]) < capacity)
        full = sum(len(members) == capacity for _, members in buckets)
        centers, records = b"", b""
        for cell, members in buckets:
            center = [(c + 0.5) * block for c in cell]
            centers += struct.pack("<3f", *center)
            for i in members:
                place = [float(values[k][i]) for k in "xyz"]
                scale = [np.exp(float(values[f"scale_{k}"][i])) for k in range(3)]
                turn = unit_quaternion(values, i)
                if level == 0:
                    records += struct.pack("<3f3f4f", *place, *scale, *turn)
                else:
                    steps = [
                        round((p - c) / (block / 2 / 32767)) + 32767
                        for p, c in zip(place, center, strict=True)
                    ]
                    records += struct.pack("<3H3e4e", *steps, *scale, *turn)
                rgb = [byte(255 * (0.5 + C0 * float(values[f"f_dc_{c}"][i]))) for c in range(3)]
                records += bytes([*rgb, byte(255 * sigmoid(values["opacity"][i]))])
                table = rest(values, i)
                for band in range(1, bands + 1):
                    for x in table[band * band - 1 : (band + 1) ** 2 - 1].T.ravel():
                        low, high = limits
                        share = byte(255 * (x - low) / (high - low))
                        records += [struct.pack("<f", x), struct.pack("<e", x), bytes([share])][level]
        sizes = b"".join(struct.pack("<I", len(members)) for _, members in buckets[full:])
        if level == 0:
            centers, sizes, count, stated, partials = b"", b"", 0, 0, 0
        else:
            count, stated, partials = len(buckets), full, len(buckets) - full
        head = struct.pack(
            "<4IfH2xI4xIIH", len(part), len(part), capacity, count, block, 12, 0, stated, partials, bands
        )
        heads += head.ljust(1024, b"\0")
        bodies += sizes + centers + records
    header = struct.pack("<BB2x4IH2x3fff", 0, 1, sections, sections, n, n, level, 0, 0, 0, *limits)
    return header.ljust(4096, b"\0") + heads + bodies


# -- SPZ


def spz_attributes(values, version, bits=12):
    """The six attributes in file order, in the axes of ``values``."""
    n = len(values["x"])
    out = {key: b"" for key in ("positions", "alphas", "colors", "scales", "rotations", "sh")}
    for i in range(n):
        for key in "xyz":
            x = float(values[key][i])
            if version == 1:
                out["positions"] += struct.pack("<e", x)
            else:
                out["positions"] += round(x * (1 << bits)).to_bytes(3, "little", signed=True)
        out["alphas"] += bytes([byte(255 * sigmoid(values["opacity"][i]))])
        out["colors"] += bytes(byte(255 * (0.5 + 0.15 * float(values[f"f_dc_{c}"][i]))) for c in range(3))
        out["scales"] += bytes(byte(16 * (float(values[f"scale_{k}"][i]) + 10)) for k in range(3))
        w, x, y, z = unit_quaternion(values, i)
        if version < 3:
            sign = -1 if w < 0 else 1
            out["rotations"] += bytes(byte(127.5 + 127.5 * sign * c) for c in (x, y, z))
        else:
            largest, others = smallest_three(np.array([x, y, z, w]))
            word = largest
            for c in others:
                word = word << 10 | int(c < 0) << 9 | round(abs(c) * np.sqrt(2) * 511)
            out["rotations"] += struct.pack("<I", word)
        out["sh"] += bytes(byte(128 + 128 * c) for c in rest(values, i).ravel())
    return out


def spz_header(values, version, bits=12, flags=0, last=0):
    degree = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}[sum(key.startswith("f_rest_") for key in values)]
    return struct.pack("<4sIIBBBB", b"NGSP", version, len(values["x"]), degree, bits, flags, last)


def spz(values, version=3, bits=12, flags=0, extensions=b""):
    """Versions 1 to 3."""
    body = b"".join(spz_attributes(values, version, bits).values())
    return gzip.compress(spz_header(values, version, bits, flags) + body + extensions, mtime=0)


def spz4(values, compress, bits=12, flags=0, extensions=b""):
    """Version 4; ``compress`` makes Zstandard frames."""
    streams = [s for s in spz_attributes(values, 4, bits).values() if s]
    packed = [compress(s) for s in streams]
    head = spz_header(values, 4, bits, flags, len(streams))
    head += struct.pack("<I12x", 32 + len(extensions)) + extensions
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    return head + table + b"".join(packed)


# -- SOG


def webp(pixels):
    """A lossless image of pixels (m, 4), 4 pixels wide, padded with zeros."""
    height = -(-len(pixels) // 4)
    padded = np.zeros((height * 4, 4), np.uint8)
    padded[: len(pixels)] = pixels
    return image(padded.reshape(height, 4, 4))


def image(pixels, kind="WEBP"):
    out = io.BytesIO()
    options = {"lossless": True, "exact": True} if kind == "WEBP" else {}
    Image.fromarray(pixels).save(out, kind, **options)
    if kind == "WEBP" and not np.array_equal(Image.open(out).convert("RGBA"), pixels):
        return image(pixels, "PNG")  # older Pillow drops colours where alpha is 0 from a WebP
    return out.getvalue()


def nearest(codebook, x):
    return int(np.argmin(np.abs(codebook - x)))


def sog(values, version=2, extra=None):
    """Files of an unpacked SOG folder."""
    n = len(values["x"])
    degree_rest = sum(key.startswith("f_rest_") for key in values) // 3
    meta = {"version": 2, "count": n} if version == 2 else {}
    files = {}
    logs = np.array(
        [[np.sign(x) * np.log1p(abs(x)) for x in (float(values[k][i]) for k in "xyz")] for i in range(n)]
    )
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.round((logs - low) / (high - low) * 65535).astype(int)
    alpha = np.full((n, 1), 255)
    files["means_l.webp"] = webp(np.hstack([steps & 255, alpha]))
    files["means_u.webp"] = webp(np.hstack([steps >> 8, alpha]))
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    if version == 1:
        meta["means"]["shape"] = [n, 3]
    turns = []
    for i in range(n):
        largest, others = smallest_three(unit_quaternion(values, i))
        turns.append([*(byte(127.5 + 127.5 * np.sqrt(2) * x) for x in others), 252 + largest])
    files["quats.webp"] = webp(np.array(turns))
    meta["quats"] = {"files": ["quats.webp"]}
    scales = np.array([[float(values[f"scale_{k}"][i]) for k in range(3)] for i in range(n)])
    colors = np.array([[float(values[f"f_dc_{c}"][i]) for c in range(3)] for i in range(n)])
    logits = np.array([[float(x)] for x in values["opacity"]])
    if version == 2:
        book = np.linspace(scales.min(), scales.max(), 256)
        files["scales.webp"] = webp([[*(nearest(book, x) for x in row), 255] for row in scales])
        meta["scales"] = {"codebook": book.tolist(), "files": ["scales.webp"]}
        book = np.linspace(colors.min(), colors.max(), 256)
        rows = [
            [*(nearest(book, x) for x in row), byte(255 * sigmoid(o[0]))]
            for row, o in zip(colors, logits, strict=True)
        ]
        files["sh0.webp"] = webp(rows)
        meta["sh0"] = {"codebook": book.tolist(), "files": ["sh0.webp"]}
    else:
        for name, table in (("scales", scales), ("sh0", np.hstack([colors, logits]))):
            low, high = table.min(axis=0), table.max(axis=0)
            pixels = np.round((table - low) / (high - low) * 255)
            files[f"{name}.webp"] = webp(np.hstack([pixels, alpha])[:, :4])
            meta[name] = {"mins": low.tolist(), "maxs": high.tolist(), "files": [f"{name}.webp"]}
    if degree_rest:
        # Each splat has an entry of its own in the palette, in reverse.
        table = np.stack([rest(values, i) for i in range(n)])[::-1]
        rows = -(-n // 64)
        palette = np.zeros((rows, 64 * degree_rest, 4), np.uint8)
        palette[..., 3] = 255
        book = np.linspace(table.min(), table.max(), 256)
        for entry in range(n):
            for j in range(degree_rest):
                palette[entry // 64, entry % 64 * degree_rest + j, :3] = [
                    nearest(book, x) for x in table[entry, j]
                ]
        files["shN_centroids.webp"] = image(palette)
        labels = np.arange(n)[::-1]
        files["shN_labels.webp"] = webp(
            np.stack([labels & 255, labels >> 8, 0 * labels, 255 + 0 * labels], axis=1)
        )
        meta["shN"] = {"files": ["shN_centroids.webp", "shN_labels.webp"]}
        if version == 2:
            bands = {3: 1, 8: 2, 15: 3}[degree_rest]
            meta["shN"] |= {"count": n, "bands": bands, "codebook": book.tolist()}
        else:
            meta["shN"] |= {"mins": float(table.min()), "maxs": float(table.max()), "quantization": 8}
    meta |= extra or {}
    files["meta.json"] = json.dumps(meta).encode()
    return files


def streamed_sog(parts, leaves, **index):
    """Files of a streamed SOG folder. ``parts``: values of splats by name of their folder; ``leaves``: for
    each place, by level, name, first splat and number of splats."""
    files = {f"{name}/{key}": data for name, values in parts.items() for key, data in sog(values).items()}
    names = list(parts)

    def level(name, offset, count):
        return {"file": names.index(name), "offset": offset, "count": count}

    nodes = [{"lods": {str(k): level(*entry) for k, entry in leaf.items()}} for leaf in leaves]
    document = {
        "version": 1,
        "asset": {"generator": "splat-transform v2.7.1"},
        "lodLevels": 1 + max(k for leaf in leaves for k in leaf),
        "filenames": [f"{name}/meta.json" for name in names],
        "tree": {"children": [nodes[0], {"children": nodes[1:]}]},
    }
    return {"lod-meta.json": json.dumps(document | index).encode(), **files}


def bundle(files, folder="", compression=zipfile.ZIP_STORED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, data in files.items():
            archive.writestr(folder + name, data)
    return out.getvalue()


# -- glTF


def splat_accessors(values, log_scales=False):
    """Attributes of KHR_gaussian_splatting: name -> (n, columns) float arrays, in the axes of ``values``."""
    n = len(values["x"])
    quaternions = np.array([unit_quaternion(values, i) for i in range(n)])
    scales = np.array([[float(values[f"scale_{k}"][i]) for k in range(3)] for i in range(n)])
    prefix = "KHR_gaussian_splatting:"
    out = {
        "POSITION": np.array([[float(values[k][i]) for k in "xyz"] for i in range(n)]),
        prefix + "ROTATION": quaternions[:, [1, 2, 3, 0]],
        prefix + "SCALE": scales if log_scales else np.exp(scales),
        prefix + "OPACITY": np.array([[sigmoid(x)] for x in values["opacity"]]),
        prefix + "SH_DEGREE_0_COEF_0": np.array(
            [[float(values[f"f_dc_{c}"][i]) for c in range(3)] for i in range(n)]
        ),
    }
    table = np.array([rest(values, i) for i in range(n)])
    j = 0
    for degree in (1, 2, 3):
        for coefficient in range(2 * degree + 1):
            if table.ndim == 3 and j < table.shape[1]:
                out[f"{prefix}SH_DEGREE_{degree}_COEF_{coefficient}"] = table[:, j]
                j += 1
    return out


def gltf(accessors=None, spz_data=None, nodes=None, kind="glb", properties=None):
    """A file of one mesh with splats: `.glb`, or `.gltf` with its data inside."""
    data = b""
    views, entries, attributes = [], [], {}
    for name, array in (accessors or {}).items():
        array = np.asarray(array)
        stored = array.astype("<f4") if array.dtype.kind == "f" else array
        columns = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.shape[1]]
        component = {"f": 5126, "i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123}
        code = component["f"] if array.dtype.kind == "f" else component[array.dtype.str[1:]]
        row = stored.tobytes()
        data += b"\0" * (-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(row)})
        entry = {"bufferView": len(entries), "componentType": code, "count": len(array), "type": columns}
        entries.append(entry | ({} if code == 5126 else {"normalized": True}))
        attributes[name] = len(attributes)
        data += row
    splatting = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"} | (properties or {})
    used = ["KHR_gaussian_splatting"]
    if spz_data is not None:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(spz_data)})
        data += spz_data
        name = "KHR_gaussian_splatting_compression_spz_2"
        splatting["extensions"] = {name: {"bufferView": len(views) - 1}}
        used.append(name)
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": used,
        "extensionsRequired": used,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"mode": 0, "attributes": attributes, "extensions": {"KHR_gaussian_splatting": splatting}}
                ]
            }
        ],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": views,
        "accessors": entries,
    }
    if kind == "gltf":
        document["buffers"][0]["uri"] = (
            "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        )
        return json.dumps(document).encode()
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


# -- LCC

LCC_LIMITS = (0.0, 0.5), (-2.0, 2.0)


def share(x, limits, most):
    return round(float(np.clip((x - limits[0]) / (limits[1] - limits[0]), 0, 1)) * most)


def lcc(values, cells=3, harmonics=True):
    """The files of a scene of two levels, of which the second has a splat of each cell."""
    n = len(values["x"])
    data, harmonics_data, index = b"", b"", b""
    for cell, part in enumerate(np.array_split(np.arange(n), cells)):
        levels = b""
        for members in (part, part[:1]):
            levels += struct.pack("<iqi", len(members), len(data), 32 * len(members))
            for i in members:
                data += struct.pack("<3f", *(float(values[k][i]) for k in "xyz"))
                data += bytes(byte(255 * (0.5 + C0 * float(values[f"f_dc_{c}"][i]))) for c in range(3))
                data += bytes([byte(255 * sigmoid(values["opacity"][i]))])
                scales = (np.exp(float(values[f"scale_{k}"][i])) for k in range(3))
                data += struct.pack("<3H", *(share(s, LCC_LIMITS[0], 65535) for s in scales))
                w, x, y, z = unit_quaternion(values, i)
                largest, others = smallest_three(np.array([x, y, z, w]))
                word = largest << 30
                for k, c in enumerate(others):
                    word |= round((c / np.sqrt(2) + 0.5) * 1023) << 10 * k
                data += struct.pack("<I3H", word, 0, 0, 0)
                for r, g, b in rest(values, i):
                    codes = (
                        share(r, LCC_LIMITS[1], 2047),
                        share(g, LCC_LIMITS[1], 1023),
                        share(b, LCC_LIMITS[1], 2047),
                    )
                    harmonics_data += struct.pack("<I", codes[0] | codes[1] << 11 | codes[2] << 21)
                harmonics_data += bytes(4)
        index += struct.pack("<hh", cell, 0) + levels
    meta = {
        "version": "5.0",
        "totalLevel": 2,
        "splats": [n, cells],
        "fileType": "Quality" if harmonics else "Portable",
        "attributes": [
            {"name": "scale", "min": [LCC_LIMITS[0][0]] * 3, "max": [LCC_LIMITS[0][1]] * 3},
            {"name": "shcoef", "min": [LCC_LIMITS[1][0]] * 3, "max": [LCC_LIMITS[1][1]] * 3},
        ],
    }
    files = {"meta.lcc": json.dumps(meta).encode(), "index.bin": index, "data.bin": data}
    return files | ({"shcoef.bin": harmonics_data} if harmonics else {})


# -- USD


def usda(
    values, up="Y", half=(), colors=None, xform="", degree=None, drop=(), prim="ParticleField3DGaussianSplat"
):
    """Text of a stage with one field, in the axes of ``values``. ``half``: attributes of half precision;
    ``colors``: name of a colour space; ``xform``: lines of the prim above; ``drop``: attributes left out."""
    n = len(values["x"])
    sh = [[[float(values[f"f_dc_{c}"][i]) for c in range(3)], *rest(values, i).tolist()] for i in range(n)]
    columns = {
        "positions": ("point3f", "point3h", [tuple(float(values[k][i]) for k in "xyz") for i in range(n)]),
        "orientations": ("quatf", "quath", [tuple(unit_quaternion(values, i)) for i in range(n)]),
        "scales": (
            *("float3", "half3"),
            [tuple(np.exp(float(values[f"scale_{k}"][i])) for k in range(3)) for i in range(n)],
        ),
        "opacities": ("float", "half", [sigmoid(x) for x in values["opacity"]]),
        "radiance:sphericalHarmonicsCoefficients": (
            *("float3", "half3"),
            [tuple(c) for splat in sh for c in splat],
        ),
    }
    lines = []
    for name, (kind, short, rows) in columns.items():
        if name in drop:
            continue
        text = ", ".join(
            repr(float(row)) if np.ndim(row) == 0 else "(" + ", ".join(repr(float(x)) for x in row) + ")"
            for row in rows
        )
        lines.append(f"{short}[] {name}h = [{text}]" if name in half else f"{kind}[] {name} = [{text}]")
    stated = int(len(sh[0]) ** 0.5) - 1 if degree is None else degree
    lines.append(f"uniform int radiance:sphericalHarmonicsDegree = {stated}")
    schemas = ""
    if colors:
        lines.append(f'uniform token colorSpace:name = "{colors}"')
        schemas = '(prepend apiSchemas = ["ColorSpaceAPI"])'
    body = "\n        ".join(lines)
    return f"""#usda 1.0
(
    defaultPrim = "World"
    upAxis = "{up}"
)
def Xform "World"
{{
    {xform}
    def {prim} "Splats" {schemas}
    {{
        {body}
    }}
}}
"""
