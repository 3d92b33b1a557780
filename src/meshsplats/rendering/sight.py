"""Whether cameras see the splats that they are to show."""

from __future__ import annotations

from collections.abc import Sequence

from meshsplats._common.arrays import subsample
from meshsplats.errors import warn_of_data
from meshsplats.rendering.api import render_splats
from meshsplats.scene.camera import OUT_OF_SIGHT, Camera, hiding_near_plane
from meshsplats.scene.gaussians import GaussianCloud

_POINTS = 20_000
"""Centres that are looked at first: most cameras see some of them."""
_SIDE = 64
"""Longer side of the images that decide where no centre is in view."""
_NAMES = 5
"""Names in a message, at most."""


def check_sight(cloud: GaussianCloud, cameras: Sequence[Camera], *, threads: int | None = None) -> None:
    """Raises ValueError if none of ``cameras`` sees any of the splats of ``cloud``; a DataWarning names those
    that see none where others do."""
    blind = [i for i, camera in enumerate(cameras) if not _sees(camera, cloud, threads)]
    if not blind or not len(cloud):
        return
    if len(blind) == len(cameras):
        reason = hiding_near_plane(cameras, cloud.means) or OUT_OF_SIGHT
        raise ValueError(
            f"none of the {len(cameras)} cameras sees any of the {len(cloud):,} splats: {reason}"
        )
    names = [cameras[i].name or f"cameras[{i}]" for i in blind]
    shown = ", ".join(names[:_NAMES]) + ", ..." * (len(names) > _NAMES)
    warn_of_data(f"{len(blind)} of {len(cameras)} cameras see none of the splats ({shown}): {OUT_OF_SIGHT}")


def _sees(camera: Camera, cloud: GaussianCloud, threads: int | None) -> bool:
    camera = camera.with_near_plane(cloud.means)
    return bool(
        camera.sees(subsample(cloud.means, _POINTS)).any()
        or camera.sees(cloud.means).any()
        or render_splats(cloud, camera.within(_SIDE), threads=threads).alpha.any()  # from beside the image
    )
