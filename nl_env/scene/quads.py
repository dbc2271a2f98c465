"""Scene geometry as parallelograms, grouped into objects.

Every surface but the ground is a parallelogram ``O + s U + t V`` with ``0 <= s, t <= 1``. Arrays are
kept component-first, ``(3, N)``, so that the renderer's set-up loop runs over contiguous memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]
Int = NDArray[np.int32]


class Quads(NamedTuple):
    """``N`` parallelograms and the material of each.

    Attributes:
        origin, u, v: ``(3, N)`` float32, corner and edges, m, world frame.
        normal: ``(3, N)`` float32, outward unit normal.
        albedo: ``(N,)`` float32, grey level before lighting.
        texture: ``(N,)`` int32, surface texture, or cut-out texture when ``cutout`` is set; -1 = plain.
        repeat: ``(2, N)`` float32, texture repeats along ``u`` and ``v``.
        shift: ``(2, N)`` float32, texture offset in repeats, non-negative.
        density: ``(N,)`` float32, texture repeats per metre along the denser edge.
        cutout: ``(N,)`` int32, 1 where the texture has holes.
        two_sided: ``(N,)`` int32, 0 where the back face is never seen.
    """

    origin: Float
    u: Float
    v: Float
    normal: Float
    albedo: Float
    texture: Int
    repeat: Float
    shift: Float
    density: Float
    cutout: Int
    two_sided: Int

    @property
    def number(self) -> int:
        """Number of parallelograms."""
        return self.albedo.shape[0]

    def packed(self) -> Float:
        """``(N, raster.PACKED)`` float32, one row per quad, as the renderer reads it."""
        flags = [np.asarray(f, np.float32)[None] for f in (self.texture, self.cutout, self.two_sided)]
        rows = (
            self.origin, self.u, self.v, self.normal, self.albedo[None], flags[0], self.repeat, self.shift,
            self.density[None], flags[1], flags[2],
        )  # fmt: skip
        return np.ascontiguousarray(np.concatenate(rows).T, np.float32)


class Objects(NamedTuple):
    """Runs of quads that are culled together.

    Attributes:
        centre: ``(3, M)`` float32 centre of the bounding sphere.
        radius: ``(M,)`` float32 its radius, m.
        first, size: ``(M,)`` int32 range of quads.
    """

    centre: Float
    radius: Float
    first: Int
    size: Int


def empty_quads() -> Quads:
    """No parallelograms."""
    vec = np.zeros((3, 0), np.float32)
    one = np.zeros(0, np.float32)
    two = np.zeros((2, 0), np.float32)
    flag = np.zeros(0, np.int32)
    return Quads(vec, vec, vec, vec, one, flag, two, two, one, flag, flag)


def texture_density(u: Float, v: Float, repeat: Float) -> Float:
    """Texture repeats per metre along the denser of the two edges."""
    lengths = np.stack([np.linalg.norm(u, axis=0), np.linalg.norm(v, axis=0)])
    return np.asarray((repeat / np.maximum(lengths, 1e-6)).max(0), np.float32)


def join(parts: list[Quads]) -> Quads:
    """Concatenate quads in order."""
    if not parts:
        return empty_quads()
    return Quads(
        *(np.ascontiguousarray(np.concatenate(field, axis=-1)) for field in zip(*parts, strict=True))
    )


class QuadBuilder:
    """Collects parallelograms of one template in its own frame (x forward, y left, z up)."""

    def __init__(self) -> None:
        self._rows: list[tuple[NDArray[np.float64], ...]] = []
        self._material: list[tuple[float, int, float, float, float, float, int, int]] = []

    def quad(
        self,
        origin: object,
        u: object,
        v: object,
        albedo: float,
        texture: int = -1,
        repeat: tuple[float, float] = (1.0, 1.0),
        shift: tuple[float, float] = (0.0, 0.0),
        cutout: bool = False,
        two_sided: bool = True,
        normal: object = None,
    ) -> None:
        """Add one parallelogram; the normal defaults to ``u x v``."""
        o, a, b = (np.asarray(p, np.float64) for p in (origin, u, v))
        n = np.cross(a, b) if normal is None else np.asarray(normal, np.float64)
        self._rows.append((o, a, b, n / (np.linalg.norm(n) + 1e-12)))
        self._material.append((albedo, texture, *repeat, *shift, int(cutout), int(two_sided)))

    def box(
        self,
        base: tuple[float, float, float],
        size: tuple[float, float, float],
        albedo: float,
        texture: int = -1,
        tile: float = 1.0,
        top: float | None = None,
        yaw: float = 0.0,
    ) -> None:
        """Add an axis-aligned box turned by ``yaw``: four sides and a top, seen from outside only.

        ``base`` is the centre of the bottom face, ``size`` the full extents, ``tile`` metres per repeat.
        """
        ex = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        ey = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        ez = np.array([0.0, 0.0, 1.0])
        x, y, z = size
        corner = np.asarray(base) - ex * x / 2 - ey * y / 2
        repeat_x, repeat_y, repeat_z = (max(1.0, float(round(s / tile))) for s in size)
        sides = ((corner, ex * x, -ey, repeat_x), (corner + ey * y, ex * x, ey, repeat_x))
        ends = ((corner, ey * y, -ex, repeat_y), (corner + ex * x, ey * y, ex, repeat_y))
        for start, along, normal, times in sides + ends:
            self.quad(
                start, along, ez * z, albedo, texture, (times, repeat_z), two_sided=False, normal=normal
            )
        self.quad(corner + ez * z, ex * x, ey * y, albedo if top is None else top, two_sided=False, normal=ez)

    def build(self) -> Quads:
        """The collected parallelograms."""
        if not self._rows:
            return empty_quads()
        o, u, v, n = (np.array(r, np.float32).T.copy() for r in zip(*self._rows, strict=True))
        m = np.array(self._material, np.float32)
        flags = m.astype(np.int32)
        repeat = m[:, 2:4].T.copy()
        return Quads(
            o, u, v, n, m[:, 0].copy(), flags[:, 1].copy(), repeat, m[:, 4:6].T.copy(),
            texture_density(u, v, repeat), flags[:, 6].copy(), flags[:, 7].copy(),
        )  # fmt: skip


def place(
    template: Quads,
    position: NDArray[np.float64],
    yaw: NDArray[np.float64],
    scale: NDArray[np.float64] | float = 1.0,
    brightness: NDArray[np.float64] | float = 1.0,
) -> tuple[Quads, Objects]:
    """Copies of ``template``, one object each.

    Args:
        template: quads in their own frame.
        position: ``(M, 3)`` metres.
        yaw: ``(M,)`` radians about z.
        scale: ``(M,)`` or scalar.
        brightness: ``(M,)`` or scalar factor on the albedo.
    """
    copies, n = len(position), template.number
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    size = np.broadcast_to(np.asarray(scale, np.float64).reshape(-1, 1), (copies, 1))
    light = np.broadcast_to(np.asarray(brightness, np.float64).reshape(-1, 1), (copies, 1))

    def turn(vectors: Float, factor: NDArray[np.float64]) -> Float:
        x, y, z = (vectors[i][None] * factor for i in range(3))
        return np.stack([cos * x - sin * y, sin * x + cos * y, z]).astype(np.float32)

    origin = turn(template.origin, size) + position.T[:, :, None].astype(np.float32)
    u, v = turn(template.u, size), turn(template.v, size)
    normal = turn(template.normal, np.ones((copies, 1)))
    corners = np.stack([origin, origin + u, origin + v, origin + u + v])
    low, high = corners.min((0, 3)), corners.max((0, 3))
    centre = (low + high) / 2
    radius = np.sqrt(((corners - centre[None, :, :, None]) ** 2).sum(1).max((0, 2)))
    origin, u, v, normal = (np.ascontiguousarray(a.reshape(3, -1)) for a in (origin, u, v, normal))
    repeat = np.tile(template.repeat, copies)
    quads = Quads(
        origin,
        u,
        v,
        normal,
        albedo=(template.albedo[None] * light).ravel().astype(np.float32),
        texture=np.tile(template.texture, copies),
        repeat=repeat,
        shift=np.tile(template.shift, copies),
        density=texture_density(u, v, repeat),
        cutout=np.tile(template.cutout, copies),
        two_sided=np.tile(template.two_sided, copies),
    )
    objects = Objects(
        centre.astype(np.float32),
        radius.astype(np.float32),
        (np.arange(copies) * n).astype(np.int32),
        np.full(copies, n, np.int32),
    )
    return quads, objects


def assemble(parts: list[tuple[Quads, Objects]]) -> tuple[Quads, Objects]:
    """Join placed templates into one world."""
    starts = np.cumsum([0, *(q.number for q, _ in parts)])
    objects = [o._replace(first=o.first + np.int32(s)) for (_, o), s in zip(parts, starts, strict=False)]
    joined = Objects(*(np.ascontiguousarray(np.concatenate(f, axis=-1)) for f in zip(*objects, strict=True)))
    return join([q for q, _ in parts]), joined
