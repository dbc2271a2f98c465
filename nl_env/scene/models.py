"""Templates of everything that stands on the ground, as parallelograms in the object's own frame.

x points forward, y left, z up; the origin is on the ground below the middle. Brightness is linear here;
lighting and gamma coding come when a template is placed.
"""

from __future__ import annotations

import math

import numpy as np

from nl_env.scene import textures as tex
from nl_env.scene.quads import QuadBuilder, Quads


def building(rng: np.random.Generator, style: str) -> Quads:
    """A house, its front at -y: tall and flat-roofed downtown, low with a gable roof elsewhere."""
    b = QuadBuilder()
    tall = style == "downtown"
    length, depth = rng.uniform(9, 16) if tall else rng.uniform(8, 14), rng.uniform(8, 14)
    height = rng.uniform(12, 45) if tall else rng.uniform(4, 12)
    wall = rng.uniform(0.25, 0.8)
    b.box(
        (0, 0, 0),
        (length, depth, height),
        wall,
        int(rng.choice([tex.WINDOW, tex.WINDOW, tex.WINDOW, tex.BRICK])),
        3.2,
        0.6 * wall,
    )
    for _ in range(int(rng.integers(0, 3))):
        along, up = rng.uniform(-length / 2, length / 2), rng.uniform(2.2, max(2.5, height - 1))
        b.box(
            (along, -depth / 2 - 0.5, up),
            (rng.uniform(1, 3), 1.0, rng.uniform(0.1, 1.0)),
            rng.uniform(0.2, 0.9),
            tex.PLANK,
            1,
        )
    if tall:
        for _ in range(int(rng.integers(0, 3))):
            x, y = rng.uniform(-length / 2, length / 2), rng.uniform(-depth / 2, depth / 2)
            b.box(
                (x, y, height),
                (rng.uniform(0.3, 2), rng.uniform(0.3, 2), rng.uniform(0.5, 3)),
                rng.uniform(0.2, 0.8),
            )
    else:
        for side in (-1, 1):
            eave = (-length / 2 - 0.4, side * (depth / 2 + 0.5), height)
            b.quad(
                eave,
                (length + 0.8, 0, 0),
                (0, -side * (depth / 2 + 0.5), 2.2),
                0.5 * wall + 0.1,
                tex.PLANK,
                (6, 3),
            )
    return b.build()


def tree(rng: np.random.Generator, cards: int, leaves: tuple[int, int], conifer: bool = False) -> Quads:
    """A tree about 8 m high: two crossed trunk planes and ``cards`` leaf planes with holes in the canopy."""
    b = QuadBuilder()
    height = 8.0
    radius, clear = height * rng.uniform(0.24, 0.38), height * rng.uniform(0.3, 0.42)
    for angle in (0.0, math.pi / 2):
        side = 0.28 * np.array([math.cos(angle), math.sin(angle), 0.0])
        b.quad(-side / 2, side, (0, 0, 0.7 * height), 0.18, tex.ROUGH, (1, 6))
    half = (height - clear) / 2
    # Few planes have to be large to fill the canopy; many small ones look better from near by.
    spread = 1 - 1 / math.sqrt(cards)
    size = radius * (0.6 + 1.0 / math.sqrt(cards))
    for _ in range(cards):
        if conifer:
            level, angle = rng.uniform(0, 1), rng.uniform(0, 2 * math.pi)
            reach = 0.7 * radius * (1 - level) * spread
            centre = np.array(
                [
                    reach * math.cos(angle),
                    reach * math.sin(angle),
                    0.5 * clear + level * (height - 0.5 * clear),
                ]
            )
        else:
            d = rng.normal(size=3)
            centre = (
                d
                / np.linalg.norm(d)
                * math.sqrt(rng.uniform(0.25, 1))
                * spread
                * np.array([radius, radius, half])
            )
            centre[2] += (clear + height) / 2
        a = rng.normal(size=3)
        a /= np.linalg.norm(a)
        c = np.cross(a, rng.normal(size=3))
        c /= np.linalg.norm(c)
        s = size * rng.uniform(0.75, 1.2)
        lit = 0.6 + 0.5 * centre[2] / 10 + rng.uniform(-0.25, 0.25)
        b.quad(
            centre - s * a - s * c, 2 * s * a, 2 * s * c, lit, int(rng.choice(leaves)), (0.996, 0.996),
            cutout=True,
        )  # fmt: skip
    return b.build()


def bare_tree(rng: np.random.Generator) -> Quads:
    """A leafless tree about 8 m high."""
    b = QuadBuilder()
    for angle in (0.0, math.pi / 2):
        side = 0.28 * np.array([math.cos(angle), math.sin(angle), 0.0])
        b.quad(-side / 2, side, (0, 0, 5.0), 0.18, tex.ROUGH, (1, 6))
    for _ in range(4):
        angle = rng.uniform(0, 2 * math.pi)
        side = 3.2 * np.array([math.cos(angle), math.sin(angle), 0.0])
        b.quad(-side + (0, 0, 8.0), 2 * side, (0, 0, -5.5), 0.2, tex.TWIGS, (0.996, 0.996), cutout=True)
    return b.build()


def bush(rng: np.random.Generator) -> Quads:
    """A bush about 1.3 m high."""
    b = QuadBuilder()
    for _ in range(5):
        centre = np.array([0, 0, 0.6]) + rng.normal(size=3) * (0.4, 0.4, 0.2)
        a = rng.normal(size=3)
        a /= np.linalg.norm(a)
        c = np.cross(a, rng.normal(size=3))
        c /= np.linalg.norm(c)
        s = rng.uniform(0.6, 1.0)
        b.quad(
            centre - s * a - s * c, 2 * s * a, 2 * s * c, rng.uniform(0.5, 0.9),
            int(rng.choice(tex.LEAVES_NEAR)), (0.996, 0.996), cutout=True,
        )  # fmt: skip
    return b.build()


def pole(rng: np.random.Generator, lamp: bool) -> Quads:
    """A lamp post with an arm over the road (towards -y), or a post with a traffic-light head."""
    b = QuadBuilder()
    height, width = rng.uniform(5, 9), rng.uniform(0.1, 0.2)
    b.box((0, 0, 0), (width, width, height), rng.uniform(0.15, 0.5))
    if lamp:
        b.quad((0, 0, height - 0.1), (0, -2.2, 0), (0, 0, 0.1), 0.3)
        b.box((0, -2.2, height - 0.15), (0.25, 0.6, 0.15), 0.4)
    else:
        b.box((0, -0.2, 0.6 * height), (0.35, 0.35, 1.0), 0.1)
    return b.build()


def sign(rng: np.random.Generator) -> Quads:
    """A traffic sign facing along x."""
    b = QuadBuilder()
    b.box((0, 0, 0), (0.07, 0.07, 2.6), 0.4)
    b.box((0, 0, 1.9), (0.04, 0.7, 0.7), float(rng.choice([0.9, 0.6, 0.3])))
    return b.build()


def furniture(rng: np.random.Generator) -> Quads:
    """A bin, a bench, a bollard or a cabinet."""
    b = QuadBuilder()
    sizes = (((0.5, 0.5, 1.0), 0.25), ((1.6, 0.5, 0.45), 0.3), ((0.3, 0.3, 0.8), 0.6), ((0.9, 0.5, 1.3), 0.4))
    size, grey = sizes[int(rng.integers(4))]
    b.box((0, 0, 0), size, grey, tex.PLANK, 1)
    return b.build()


def barrier() -> Quads:
    """Four metres of guard rail on a post."""
    b = QuadBuilder()
    b.quad((-2, 0, 0.45), (4, 0, 0), (0, 0, 0.32), 0.6, tex.PLANK, (4, 1))
    b.quad((0, 0, 0), (0.15, 0, 0), (0, 0, 0.75), 0.45)
    return b.build()


def fence(rng: np.random.Generator) -> Quads:
    """Five metres of wire fence."""
    b = QuadBuilder()
    height = rng.uniform(1.0, 2.0)
    b.quad((-2.6, 0, 0), (5.2, 0, 0), (0, 0, height), rng.uniform(0.2, 0.7), tex.MESH, (3, 1), cutout=True)
    return b.build()


def kerb() -> Quads:
    """Four metres of kerb: the face towards the road (-y) and the top."""
    b = QuadBuilder()
    b.quad((-2, 0, 0), (4, 0, 0), (0, 0, 0.14), 0.5, two_sided=False, normal=(0, -1, 0))
    b.quad((-2, 0, 0.14), (4, 0, 0), (0, 0.2, 0), 0.65, two_sided=False, normal=(0, 0, 1))
    return b.build()


def car(rng: np.random.Generator, length: float, width: float, height: float) -> Quads:
    """A car of the given outline: body, cabin, wheels, lights and plates."""
    b = QuadBuilder()
    grey = float(rng.choice([0.08, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9]))
    waist = 0.57 * height
    b.box((0, 0, 0.3), (length, width, waist - 0.3), grey)
    b.box(
        (-0.03 * length, 0, waist),
        (0.55 * length, 0.88 * width, height - waist),
        0.9 * grey + 0.02,
        tex.CAR,
        2.6,
        grey,
    )
    front, rear = length / 2 + 0.01, -length / 2 - 0.01
    for y in (-width / 2 + 0.1, width / 2 - 0.45):
        b.quad((front, y, 0.6), (0, 0.35, 0), (0, 0, 0.16), 0.95, two_sided=False, normal=(1, 0, 0))
        b.quad((rear, y, 0.62), (0, 0.35, 0), (0, 0, 0.16), 0.5, two_sided=False, normal=(-1, 0, 0))
    b.quad((rear, -0.25, 0.42), (0, 0.5, 0), (0, 0, 0.13), 0.85, two_sided=False, normal=(-1, 0, 0))
    for x in (-0.31 * length, 0.31 * length):
        for side in (-1, 1):
            y = side * (width / 2 + 0.01)
            b.quad((x - 0.32, y, 0), (0.64, 0, 0), (0, 0, 0.64), 0.05, two_sided=False, normal=(0, side, 0))
    return b.build()


def truck(rng: np.random.Generator, length: float, width: float, height: float) -> Quads:
    """A box truck of the given outline."""
    b = QuadBuilder()
    grey = rng.uniform(0.2, 0.9)
    b.box((-0.9, 0, 0.6), (length - 1.8, width, height - 0.6), grey, tex.PLANK, 4)
    b.box(
        (length / 2 - 0.9, 0, 0.5), (1.8, width, 0.6 * height), float(rng.choice([0.2, 0.6, 0.8])), tex.CAR, 3
    )
    b.box((0, 0, 0.3), (length, 0.8 * width, 0.35), 0.1)
    b.quad(
        (-length / 2 - 0.01, -0.25, 0.65), (0, 0.5, 0), (0, 0, 0.13), 0.85, two_sided=False, normal=(-1, 0, 0)
    )
    return b.build()


def pedestrian(rng: np.random.Generator, height: float) -> Quads:
    """A standing person."""
    b = QuadBuilder()
    coat, legs = rng.uniform(0.1, 0.8), rng.uniform(0.05, 0.4)
    s = height / 1.75
    for y in (-0.1, 0.1):
        b.box((0, y * s, 0), (0.16 * s, 0.14 * s, 0.85 * s), legs, tex.ROUGH, 0.5)
    b.box((0, 0, 0.85 * s), (0.24 * s, 0.44 * s, 0.62 * s), coat, tex.ROUGH, 0.5)
    b.box((0, 0, 1.49 * s), (0.2 * s, 0.2 * s, 0.25 * s), 0.5)
    return b.build()
