"""Tiny ELiDAR files with known content, and a stand-in for a recording to export."""

from __future__ import annotations

import h5py
import numpy as np

from nl_env.elidar.export import ExportOptions, assemble, write_part
from nl_env.representations import event_frame, voxel_grid
from nl_env.sensors.lidar import quantise
from nl_env.types import BINS, EVENT_DTYPE, SLICE_US, Camera

SIZE = (6, 8)
HEADER = "split,sequence,events_id,prior_depth_frame_id,gt_depth_frame_id,duration"
ROWS = [(0, 0, 2, 10), (1, 0, 1, 4), (2, 1, 2, 6), (3, 2, 3, 20), (4, 2, 3, 20)]
"""Frames at ticks 0, 4, 10, 30; the last row is a duplicate."""
TICKS = [0, 4, 10, 30]


class Source:
    """A recording of random events over a wall that is 10 m away and leaves by 1 m a slice; row 0 is sky."""

    def __init__(self, seed, slices=30, depth_period_us=10_000, size=SIZE):
        rng = np.random.default_rng(seed)
        self.seed = seed
        self.camera = Camera.from_fov(*size, 75.0)
        self.slices = slices
        self.max_depth = 200.0
        self.depth_period_us = depth_period_us
        self.events = np.zeros(60 * slices, EVENT_DTYPE)
        self.events["t"] = np.sort(rng.integers(0, slices * SLICE_US, len(self.events)))
        self.events["x"] = rng.integers(0, size[1], len(self.events))
        self.events["y"] = rng.integers(0, size[0], len(self.events))
        self.events["p"] = rng.choice([-1, 1], len(self.events))
        self.speed = rng.uniform(0, 20, slices + 1)
        self.shortest_distance = rng.uniform(0, 50, slices + 1)
        self.shortest_distance[-2] = np.inf
        self.new_actors = rng.integers(0, 2, slices + 1)
        self.keyframe = (self.speed > 10) | (self.shortest_distance < 8) | (self.new_actors > 0)

    def depth(self, t_us):
        assert t_us % self.depth_period_us == 0
        depth = np.full(self.camera.shape, 10 + t_us / SLICE_US, np.float32)
        depth[0] = 0
        return quantise(depth, self.max_depth)

    def voxel(self, t0_us, t1_us):
        return voxel_grid(self.events, self.camera.shape, t0_us, t1_us)

    def bins(self, k):
        assert k > 0
        return self.voxel((k - 1) * SLICE_US, k * SLICE_US).astype(np.int16)

    def event_frame(self, k):
        return event_frame(self.events, self.camera.shape, (k - 1) * SLICE_US, k * SLICE_US)


def export(folder, named, options=None):
    """Export ``(name, split, source)`` to ``folder/data``; returns that folder."""
    data = folder / "data"
    data.mkdir(exist_ok=True)
    parts = []
    for name, split, source in named:
        part = folder / f"{name}.h5"
        write_part(part, source, name, split, options or ExportOptions(), data)
        parts.append(part)
    assemble(parts, data)
    return data


def frame(k, size=SIZE):
    """Content of depth frame k: k + 1 m, its first row beyond any range."""
    depth = np.full((1, *size), k + 1, np.float32)
    depth[0, 0] = 1000
    return depth


def grid(k, size=SIZE):
    """Content of voxel grid k."""
    return np.arange(BINS * size[0] * size[1]).reshape(BINS, *size) % 7 - 3 + k


def write_pairs(folder, sequences=(("train", "Town01_Opt_00"),), rows=ROWS, **dataset):
    """An extrapolation HDF5 and its CSV in ``folder``; extra arguments go to the events dataset."""
    folder.mkdir(exist_ok=True)
    hdf5, metadata = folder / "pairs.h5", folder / "pairs_metadata.csv"
    with h5py.File(hdf5, "w") as file:
        for _, name in sequences:
            file[f"{name}/depth_frames"] = np.stack([frame(k) for k in range(len(TICKS))])
            grids = np.stack([grid(k) for k in range(len(rows))])
            file.create_dataset(f"{name}/events", data=grids, **dataset)
    lines = [",".join(map(str, (*place, *row))) for place in sequences for row in rows]
    metadata.write_text("\n".join([HEADER, *lines]) + "\n")
    return hdf5, metadata


def write_raw(path, **changes):
    """A raw sequence of four slices; ``changes`` replace arrays, None leaves one out."""
    arrays = {
        "frames": np.arange(4 * 48).reshape(4, *SIZE).astype(np.int32) - 90,
        "key_frame": np.array([0, 1, 1, 0]),
        "ego_velocity": np.array([0.0, 11.0, 3.0, -2.0]),
        "shortest_distance": np.array([np.inf, 20.0, 7.5, 30.0]),
        "num_new_actors": np.array([0, 0, 0, 0]),
        **changes,
    }
    np.savez_compressed(path, **{name: array for name, array in arrays.items() if array is not None})
    return path
