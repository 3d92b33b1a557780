"""Options of a surface."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal, TypedDict

from meshsplats._common.options import Advanced, Range, With, check_options

Shape = Literal["auto", "closed", "open", "floor"]

MAX_RESOLUTION = 512
"""Maximum number of voxels along the longest side of the grid."""
LEVEL_FACTOR = 2
"""Sides of the textures and of the images of each level of detail, relative to the next; of triangles the
square."""
MAX_TEXTURE = 8192
"""Largest side of a texture."""
CLOSED, OPEN = (20_000, 2048), (60_000, 4096)
"""Default numbers of triangles, and sides of the texture, of closed surfaces and of open ones."""
USUAL_RESOLUTION = 256
"""Default number of voxels along the longest side of closed surfaces, and the least of open ones."""


@dataclass(frozen=True)
class SurfaceOptions:
    """The options of ``make_surface``."""

    faces: Annotated[int | None, Range(0, 10_000_000)] = None
    """Approximate largest number of triangles; 0: as many as the voxels give. Default: 20,000 of closed
    surfaces, 60,000 of open ones, or as many as an atlas can be made of."""
    texture: Annotated[int | None, Range(0, MAX_TEXTURE)] = None
    """Side of the texture in texels; 0: vertex colours instead. Default: 2048 for closed surfaces, 4096
    for open ones."""
    normal_map: Annotated[bool, With("texture")] = True
    """Keep the relief of the finest triangles as a normal map, of a quarter of the texture's side."""
    shape: Shape = "auto"
    """closed: watertight, a solid for all sides; what no image sees becomes interior. open: only what images
    see, for rooms, streets and gardens. floor: open, but for the ground below and between the views,
    for walking. auto: closed for objects, open for places."""
    resolution: Annotated[int | None, Range(8, MAX_RESOLUTION)] = None
    """Voxels along the longest side, from whose surface triangles are made. Memory grows with its cube.
    Default: 256; of open surfaces up to 512, where one sees much less far than they reach, as in the rooms of
    a flat."""
    views: Annotated[int, Range(4, 1000)] = 64
    """Images that are made of the scene, from all around or, of a place, from within."""
    size: Annotated[int, Range(16, 4096)] = 800
    """Side of these images in pixels; photographs are used at most this wide."""
    rounds: Annotated[int, Range(0, 1000)] = 3
    """How often shape and texture are compared with each image; 0: the surface stays as fused, and has the
    mean colours of the images."""
    sh_degree: Annotated[int | None, Range(0, 3), Advanced] = None
    """Largest degree of the splats' view-dependent colour in the images. Default: all."""
    move: Annotated[float, Range(0, 10), With("rounds"), Advanced] = 0.5
    """Step of the vertices, relative to the length of an edge."""
    stiffness: Annotated[float, Range(0, 1000), With("rounds"), Advanced] = 2.0
    """How far a vertex takes its neighbours along: the weight of the Laplacian."""

    def checked(self) -> SurfaceOptions:
        """The same options. Raises ValueError for one out of its range."""
        sized = self.sized(closed=True)
        check_options(sized)
        if 0 < sized.faces < 4:
            raise ValueError(f"faces must be 4 or more, or 0 for all, got {sized.faces}")
        if 0 < sized.texture < 64:
            raise ValueError(f"texture must be 64 texels or more, or 0 for none, got {sized.texture}")
        return self

    def sized(self, closed: bool) -> SizedOptions:
        """These options, with the default numbers of triangles and texels of a closed surface, or of an open
        one, where they name none."""
        faces, texture = CLOSED if closed else OPEN
        values = {part.name: getattr(self, part.name) for part in fields(SurfaceOptions)}
        chosen = {"faces": faces, "texture": texture}
        return SizedOptions(**values | {name: n for name, n in chosen.items() if values[name] is None})


@dataclass(frozen=True)
class SizedOptions(SurfaceOptions):
    """The options of a surface of a known kind."""

    faces: int = CLOSED[0]
    texture: int = CLOSED[1]


def default_in_words(name: str) -> str:
    """The default of an option, and that of open surfaces, where it is another."""
    if name == "resolution":
        return f"(default: {USUAL_RESOLUTION}; open surfaces: to {MAX_RESOLUTION})"
    closed, place = (getattr(SurfaceOptions().sized(kind), name) for kind in (True, False))
    return f"(default: {closed})" if closed == place else f"(default: {closed}; open surfaces: {place})"


def level_options(options: SizedOptions, count: int) -> list[SizedOptions]:
    """The options of ``count`` levels of detail, from the finest on; ``faces`` of 0 stay, as each level has a
    quarter of the triangles of the one before. ValueError for levels that are too small, or none."""
    if count < 1:
        raise ValueError(f"levels must be 1 or more, got {count}")
    levels = [
        replace(
            options,
            faces=options.faces // LEVEL_FACTOR ** (2 * k),
            texture=options.texture // LEVEL_FACTOR**k,
            size=options.size // LEVEL_FACTOR**k,
        )
        for k in range(count)
    ]
    least = levels[-1]
    try:
        for level in levels:
            level.checked()
        if not (least.faces or not options.faces) or not (least.texture or not options.texture):
            raise ValueError("nothing is left")
    except ValueError as error:
        raise ValueError(f"fewer than {count} levels: the coarsest would be too small: {error}") from error
    return levels


class SurfaceChanges(TypedDict, total=False):
    """The fields of ``SurfaceOptions`` as keywords, for type checkers and editors."""

    faces: int | None
    texture: int | None
    normal_map: bool
    shape: Shape
    resolution: int | None
    views: int
    size: int
    rounds: int
    sh_degree: int | None
    move: float
    stiffness: float
