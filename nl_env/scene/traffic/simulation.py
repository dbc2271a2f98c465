"""Simulate a scenario: drivers first, then pedestrians, then one set of trajectories."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nl_env.config import SCENARIOS, choice, number
from nl_env.scene.traffic.drivers import STEP, Driver
from nl_env.scene.traffic.pedestrians import populate_pavements
from nl_env.scene.traffic.roads import world_lanes
from nl_env.scene.traffic.scenarios import LAYOUTS, Flow, Layout
from nl_env.scene.traffic.trajectories import Actor, Tracks, Traffic, overlaps

URBAN = ("intersection", "roundabout", "u-turn", "two-way")
URBAN_SPEEDS = (5.0, 13.0)
HIGHWAY_SPEEDS = (17.0, 29.0)
"""Ranges of the ego's cruising speed, m/s."""

EGO_SIZE = (4.7, 1.85)
VIEW = 220.0
"""Lanes farther than this from the ego's path are left out, m."""

NEAR_MISS = 0.5
"""Vehicles that come closer than this to another one are left out of the sequence, m."""

WARM_UP = 2.0
"""Seconds simulated before time 0, so that the sequence starts in flowing traffic."""


def simulate(scenario: str, seed: int, duration_s: float) -> Traffic:
    """Traffic around an ego vehicle that drives through ``scenario``, determined by the three arguments.

    Args:
        scenario: one of ``nl_env.config.SCENARIOS``.
        seed: non-negative integer.
        duration_s: length of the sequence, s, in ``(0, 120]``.

    Raises:
        ValueError: an argument is not what is expected.
    """
    choice("scenario", scenario, SCENARIOS)
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed: found {seed!r}, expected a non-negative integer")
    number("duration_s", duration_s, 0.001, 120.0)
    rng = np.random.default_rng((seed, SCENARIOS.index(scenario)))
    urban = scenario in URBAN
    cruise = float(rng.uniform(*(URBAN_SPEEDS if urban else HIGHWAY_SPEEDS)))
    layout = LAYOUTS[scenario](rng, cruise, duration_s)
    actors = populate(layout, rng, cruise, trucks=0.08 if urban else 0.2)
    slow_down = None if urban or rng.random() < 0.25 else _slow_down(rng, duration_s)
    knots = drive(layout, duration_s, slow_down) * (1.0, -1.0, -1.0)

    duration_us = round(duration_s * 1e6)
    sizes = np.array([EGO_SIZE, *((a.length, a.width) for a in actors)])
    instants = np.arange(0, duration_us + 1, 20_000)
    kept = without_collisions(Tracks(knots).sample(instants), sizes)
    knots, sizes, actors = knots[:, kept], sizes[kept], [actors[k - 1] for k in kept[1:]]

    lanes = world_lanes(layout.street.network, knots[::4, 0, :2], VIEW)
    if urban:
        walkers, walks = populate_pavements(rng, lanes, layout.crossings, knots, sizes)
        actors, knots = actors + walkers, np.concatenate((knots, walks), axis=1)
    return Traffic(
        scenario=scenario,
        seed=int(seed),
        duration_us=duration_us,
        lanes=lanes,
        crossings=tuple(layout.crossings),
        actors=tuple(actors),
        ego_size=EGO_SIZE,
        ego_track=Tracks(knots[:, :1]),
        actor_tracks=Tracks(knots[:, 1:]),
    )


def populate(layout: Layout, rng: np.random.Generator, cruise: float, trucks: float) -> list[Actor]:
    """Put the ego (first) and the flows on the street, ``WARM_UP`` before time 0; return the others."""
    street = layout.street
    back = cruise * WARM_UP
    ego = Driver(
        street, layout.lane, layout.position - back, cruise, layout.turns, EGO_SIZE, layout.changes_lanes
    )
    street.vehicles.append(ego)
    actors = []
    for flow in layout.flows:
        for position in _spread(flow, rng):
            actor = _truck(rng) if rng.random() < trucks else _car(rng)
            turns = flow.routes[int(rng.integers(len(flow.routes)))]
            pace = cruise * rng.uniform(0.85, 1.1)
            lane = street.network.get_lane(flow.lane)
            driver = Driver(
                street,
                flow.lane,
                max(position - back, 5.0) if lane.length > 100.0 else position,
                float(pace),
                turns,
                (actor.length, actor.width),
                layout.changes_lanes,
            )
            if not any(_too_close(driver, other) for other in street.vehicles):
                street.vehicles.append(driver)
                actors.append(actor)
    return actors


def _too_close(driver: Driver, other: Driver) -> bool:
    """Whether two vehicles start side by side or closely behind each other on the same lane."""
    dx, dy = other.position - driver.position
    c, s = math.cos(driver.heading), math.sin(driver.heading)
    return abs(c * dx + s * dy) < 12.0 and abs(c * dy - s * dx) < 3.0


def _spread(flow: Flow, rng: np.random.Generator) -> NDArray[np.float64]:
    """Positions of the vehicles of ``flow``, one at random in each of ``count`` equal stretches."""
    cells = np.arange(flow.count) + rng.uniform(0.1, 0.9, flow.count)
    return flow.begin + cells * max(flow.end - flow.begin, 0.0) / flow.count


def _car(rng: np.random.Generator) -> Actor:
    return Actor("car", *map(float, rng.uniform((4.0, 1.7, 1.4), (4.9, 1.9, 1.75))))


def _truck(rng: np.random.Generator) -> Actor:
    return Actor("truck", *map(float, rng.uniform((6.5, 2.2, 2.7), (9.5, 2.45, 3.6))))


def _slow_down(rng: np.random.Generator, duration: float) -> tuple[list[float], list[float]]:
    """Times (s) and factors on speed of a brief slow-down somewhere in the sequence."""
    begin = float(rng.uniform(0.1, 0.6)) * duration
    hold, factor = float(rng.uniform(2.0, 6.0)), float(rng.uniform(0.2, 0.6))
    return [begin, begin + 4.0, begin + 4.0 + hold, begin + 6.0 + hold], [1.0, factor, factor, 1.0]


def drive(
    layout: Layout, duration: float, slow_down: tuple[list[float], list[float]] | None
) -> NDArray[np.float64]:
    """Simulate; ``(K, n, 3)`` poses of all vehicles in highway-env's frame from one step before time 0 on."""
    street = layout.street
    before = round(WARM_UP / STEP)
    street.time = -before * STEP
    steps = before + int(duration / STEP) + 4
    poses = np.empty((steps, len(street.vehicles), 3))
    for k in range(steps):
        poses[k] = [(*vehicle.position, vehicle.heading) for vehicle in street.vehicles]
        if slow_down is not None:
            street.pace = float(np.interp(street.time, *slow_down))
        street.act()
        street.step(STEP)
    return poses[before - 1 :]


def without_collisions(poses: NDArray[np.float64], sizes: NDArray[np.float64]) -> list[int]:
    """Indices of bodies that keep apart: the ego (0) stays, of two others the one in more conflicts goes."""
    met = overlaps(poses, sizes + NEAR_MISS)
    kept = np.ones(len(sizes), dtype=bool)
    kept[1:] &= ~met[0, 1:]
    while (conflicts := (met & kept & kept[:, None]).sum(axis=1)).any():
        kept[int(np.argmax(conflicts))] = False
    return np.flatnonzero(kept).tolist()
