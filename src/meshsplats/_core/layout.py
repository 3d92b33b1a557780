"""Whether the structures of the compiled core are those of ``structures``: every field at the same place."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from ctypes import POINTER, c_char, c_char_p, c_double, c_float, c_int32, c_void_p

from meshsplats._core.structures import CoreStruct


class _Field(ctypes.Structure):
    """MsField of csrc/layout.h."""

    _fields_ = [("name", c_char_p), ("offset", c_int32), ("size", c_int32), ("kind", c_char)]


def check_layout(library: ctypes.CDLL) -> None:
    """Raises ImportError unless every structure of the core has the same fields here, at the same places."""
    library.ms_layout.restype = POINTER(_Field)
    library.ms_layout.argtypes = [POINTER(c_int32)]
    count = c_int32()
    fields = library.ms_layout(count)
    theirs = {f.name.decode(): (f.offset, f.size, f.kind.decode()) for f in fields[: count.value]}
    known = {name for name in theirs if "." not in name}
    ours: dict[str, tuple[int, int, str]] = {}
    for struct in CoreStruct.__subclasses__():
        name = f"Ms{struct.__name__.removesuffix('Struct')}"
        if name in known:  # the cores of wide vectors lack some
            ours |= layout(name, struct)
    wrong = sorted(name for name in {*ours, *theirs} if ours.get(name) != theirs.get(name))
    if wrong:
        raise ImportError(
            f"the compiled core and the Python code differ in {', '.join(wrong[:4])}: install the package"
            " again"
        )


def layout(name: str, struct: type[ctypes.Structure]) -> Iterator[tuple[str, tuple[int, int, str]]]:
    """Offset and size in bytes and kind of ``struct`` and of its fields, as csrc/layout.h names them."""
    yield name, (0, ctypes.sizeof(struct), "s")
    for field, kind, *_ in struct._fields_:
        place = getattr(struct, field)
        yield f"{name}.{field}", (place.offset, place.size, _kind(kind))


def _kind(field: type) -> str:
    if issubclass(field, ctypes.Array):
        return _kind(field._type_)  # type: ignore[arg-type]
    if issubclass(field, ctypes.Structure):
        return "s"
    if issubclass(field, c_void_p):
        return "p"
    return "f" if issubclass(field, (c_float, c_double)) else "i"
