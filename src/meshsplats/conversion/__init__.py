"""Conversion: splats to a mesh of translucent triangle fans."""

from typing import TYPE_CHECKING

from meshsplats._common.lazy import lazy_names

__all__ = [
    "PRESETS",
    "ConversionOptions",
    "Profile",
    "bake_filter",
    "convert",
    "fidelity",
    "fit_profile",
    "simplify",
]

if TYPE_CHECKING:
    from meshsplats.conversion.baking import bake_filter
    from meshsplats.conversion.converting import convert
    from meshsplats.conversion.merging import simplify
    from meshsplats.conversion.options import PRESETS, ConversionOptions
    from meshsplats.conversion.profiles import Profile, fidelity, fit_profile
else:
    _HOME = {
        "meshsplats.conversion.baking": ("bake_filter",),
        "meshsplats.conversion.converting": ("convert",),
        "meshsplats.conversion.merging": ("simplify",),
        "meshsplats.conversion.options": ("PRESETS", "ConversionOptions"),
        "meshsplats.conversion.profiles": ("Profile", "fidelity", "fit_profile"),
    }
    __getattr__ = lazy_names(__name__, _HOME)
