"""The demo scene's light, baked into spherical harmonics: key light, soft shadows, sky, gloss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshsplats.scene.gaussians import SH_C0
from meshsplats.scene.spherical_harmonics import sh_basis

KEY_LIGHT = np.array([-0.60, -0.70, -0.40]) / np.linalg.norm([-0.60, -0.70, -0.40])
"""(3,) unit direction towards the key light: above, left of and in front of the table."""


@dataclass
class Patch:
    """Splats before lighting, n of them. The frame of a splat is (tangent, normal x tangent, normal)."""

    points: np.ndarray
    """(n, 3)"""
    normals: np.ndarray
    """(n, 3) unit, outwards."""
    tangents: np.ndarray
    """(n, 3) unit, at right angles to the normal."""
    sigmas: np.ndarray
    """(n, 3) standard deviations along the frame."""
    albedo: np.ndarray
    """(n, 3) linear reflectance."""
    opacities: np.ndarray
    """(n,)"""
    gloss: float = 0.0
    """Height of the highlight in display RGB."""
    translucency: float = 0.0
    """Share of light transmitted from the back."""
    occlusion: np.ndarray | None = None
    """(n,) share of the sky light that arrives, apart from occlusion by other objects; None: all of it."""
    sunlit: np.ndarray | None = None
    """(n,) the same of the key light."""


def diffuse(patch: Patch, blockers: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """(n, 3) display RGB of the diffuse light that leaves each splat."""
    lit = patch.normals @ KEY_LIGHT
    through = patch.translucency
    key = (1 - through) * np.clip(lit, 0, None) + through * np.abs(lit)
    shadow = np.zeros(len(lit))
    sky = np.ones(len(lit)) if patch.occlusion is None else patch.occlusion.copy()
    for center, radius, density in zip(*blockers, strict=True):
        to = center - patch.points
        distance = np.linalg.norm(to, axis=1)
        outside = distance > 1.15 * radius  # a surface does not block itself
        forwards = to @ KEY_LIGHT
        beside = np.sqrt(np.clip(distance**2 - forwards**2, 0, None))
        # The penumbra widens with the distance from the blocker.
        soft = 0.035 + 0.16 * np.clip(forwards, 0, None)
        cover = np.clip(0.5 + (radius - beside) / soft, 0, 1)
        shadow += density * cover * cover * (3 - 2 * cover) * (outside & (forwards > 0))
        if density > 1:  # ambient occlusion by a sphere: cosine times solid angle
            cosine = np.clip((patch.normals * to).sum(1) / distance, 0, 1)
            sky *= 1 - outside * cosine * np.clip(radius / distance, 0, 1) ** 2 * 0.75
    key = key * np.exp(-shadow) * (1.0 if patch.sunlit is None else patch.sunlit)
    light = column(key) * [1.75, 1.60, 1.36]
    upwards = 0.5 - 0.5 * patch.normals[:, 1]
    light = light + column(sky * (0.14 + 0.26 * upwards)) * [0.80, 0.94, 1.14]
    linear = np.clip(patch.albedo, 0, 1) * light
    return np.clip(1.03 * (1 - np.exp(-1.15 * linear)), 0, 1) ** (1 / 2.2)


def spherical_harmonics(patch: Patch, color: np.ndarray) -> np.ndarray:
    """(n, 16, 3) float32 coefficients: ``color`` and, on glossy things, a highlight and a sheen.

    A function f(t) = sum_l f_l P_l(t) of the cosine t to an axis has the coefficients
    f_l * 4 pi / (2 l + 1) * Y_lm(axis) (addition theorem). Colour is stored against the direction from the
    camera to the splat, so the axis is minus the mirrored light.
    """
    sh = np.zeros((len(color), 16, 3), np.float32)
    sh[:, 0] = (color - 0.5) / SH_C0
    if patch.gloss == 0:
        return sh
    mirrored = 2 * column(patch.normals @ KEY_LIGHT) * patch.normals - KEY_LIGHT
    facing = np.clip(4 * (patch.normals @ KEY_LIGHT), 0, 1)
    # max(t, 0)^8 to degree 3, scaled to 1 at its peak; damped a little so that it does not ring below zero.
    highlight = np.array([0.0556, 0.150, 0.186, 0.135]) / 0.5266
    # 1 - t^2 = 2/3 P_0 - 2/3 P_2
    sheen = np.array([2 / 3, 0, -2 / 3, 0])
    tint = np.array([1.0, 0.97, 0.90])
    toward_light, toward_normal = sh_basis(-mirrored, 3), sh_basis(-patch.normals, 3)
    for level in range(4):
        band = slice(level**2, (level + 1) ** 2)
        weight = 4 * np.pi / (2 * level + 1)
        one = highlight[level] * column(patch.gloss * facing) * toward_light[:, band]
        other = 0.2 * patch.gloss * sheen[level] * toward_normal[:, band]
        sh[:, band] += (weight * (one + other))[:, :, None] * tint
    return sh


def column(values: np.ndarray) -> np.ndarray:
    return np.asarray(values)[:, None]


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def mix(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    return a + (b - a) * column(t)
