"""The errors and warnings that users meet. Each message says what, got what, and what to do."""

from __future__ import annotations


class FileFormatError(ValueError):
    """A file that cannot be read as what it was taken for: broken, truncated, hostile or of another kind."""


class MissingDependencyError(ImportError):
    """An optional library is needed here; the message says how to install it."""


GET_TORCH = (
    "the build for processors will do: pip install torch --index-url https://download.pytorch.org/whl/cpu"
)
"""For messages: torch as most registries have it brings gigabytes of CUDA libraries on Linux."""


class DataWarning(UserWarning):
    """Something in the data was left out or altered; the message counts it."""


class NoColorsWarning(DataWarning):
    """A mesh file without vertex colours was read as grey."""


class NoTextureWarning(DataWarning):
    """The textures of a mesh file were left out."""


class DivergenceError(ValueError):
    """Values that are not finite turned up in an optimisation; the message names the view that brought
    them."""
