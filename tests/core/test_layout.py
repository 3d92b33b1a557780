"""The structures of the compiled core and those of the Python code are the same."""

import ctypes
from ctypes import c_double, c_float, c_int32, c_int64, c_void_p

import pytest

from meshsplats._core import layout as core_layout
from meshsplats._core import structures
from meshsplats._core.layout import check_layout, layout
from meshsplats._core.library import available_variants, load_core
from meshsplats._core.structures import CoreStruct


def test_every_structure_of_the_baseline_core_is_mirrored():
    if "baseline" not in available_variants():
        pytest.skip("MESHSPLATS_LIBRARY takes the place of the variants")
    core = load_core("baseline")
    count = c_int32()
    fields = core.ms_layout(count)
    known = {field.name.decode() for field in fields[: count.value]}
    mirrored = {f"Ms{struct.__name__.removesuffix('Struct')}" for struct in CoreStruct.__subclasses__()}
    assert mirrored == {name for name in known if "." not in name}


def test_a_layout_names_places_sizes_and_kinds():
    class Inner(ctypes.Structure):
        _fields_ = [("x", c_float)]

    class Outer(ctypes.Structure):
        _fields_ = [("count", c_int32), ("values", c_void_p), ("matrix", c_double * 3), ("inner", Inner)]

    assert dict(layout("MsOuter", Outer)) == {
        "MsOuter": (0, 48, "s"),
        "MsOuter.count": (0, 4, "i"),
        "MsOuter.values": (8, 8, "p"),
        "MsOuter.matrix": (16, 24, "f"),
        "MsOuter.inner": (40, 4, "s"),
    }


FANS = structures.FansStruct._fields_


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ([*FANS[:3], FANS[4], FANS[3], FANS[5]], "MsFans.polygon, MsFans.vertices"),  # in another order
        ([*FANS[:-1], ("share", c_int64)], "MsFans.share"),  # another type of the same size
        ([*FANS, ("more", c_int32)], "MsFans, MsFans.more"),
        (FANS[:-1], "MsFans, MsFans.share"),
    ],
)
def test_a_structure_that_differs_is_refused_by_name(monkeypatch, fields, named):
    other = type("FansStruct", (ctypes.Structure,), {"_fields_": fields})
    stand_ins = [other if s is structures.FansStruct else s for s in CoreStruct.__subclasses__()]
    monkeypatch.setattr(core_layout, "CoreStruct", type("", (), {"__subclasses__": lambda: stand_ins}))
    with pytest.raises(ImportError, match=f"differ in {named}: install"):
        check_layout(load_core())
