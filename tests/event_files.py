"""Small files in the layouts of real event recordings, written as their formats are published."""

import h5py
import numpy as np
from PIL import Image

from nl_env.types import EVENT_DTYPE

DSEC_SHAPE = (480, 640)


def some_events(shape, duration_us, count, seed=0, start_us=0):
    """``count`` sorted events at random times and pixels."""
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT_DTYPE)
    events["t"] = start_us + np.sort(rng.integers(0, duration_us, count))
    events["x"], events["y"] = rng.integers(0, shape[1], count), rng.integers(0, shape[0], count)
    events["p"] = rng.choice([-1, 1], count)
    return events


def ms_index(times, length):
    """Number of the first event at or after every millisecond."""
    return np.searchsorted(times, 1000 * np.arange(length)).astype(np.uint64)


def write_dsec(path, events, t_offset=None, **filters):
    """``events/*``, ``ms_to_idx`` and ``t_offset``; the stored times are relative to the offset."""
    times = events["t"] - (t_offset or 0)
    with h5py.File(path, "w") as file:
        for name, kind in {"x": "u2", "y": "u2", "p": "u1", "t": "u4"}.items():
            values = times if name == "t" else (events[name] > 0) if name == "p" else events[name]
            file.create_dataset(f"events/{name}", data=values.astype(kind), **filters)
        file["ms_to_idx"] = ms_index(times, int(times[-1]) // 1000 + 2)
        if t_offset is not None:
            file["t_offset"] = np.int64(t_offset)
    return path


def write_m3ed(path, events, shape, intrinsics=None, group="prophesee/left"):
    """M3ED's group of a camera, or with another ``group`` EvTTC's; the index ends with the last whole ms."""
    height, width = shape
    with h5py.File(path, "w") as file:
        for name, kind in {"x": "u2", "y": "u2", "p": "i1", "t": "i8"}.items():
            values = (events[name] > 0) if name == "p" else events[name]
            file.create_dataset(
                f"{group}/{name}", data=values.astype(kind), compression="lzf", maxshape=(None,)
            )
        file[f"{group}/ms_map_idx"] = ms_index(events["t"], int(events["t"][-1]) // 1000)
        file[f"{group}/calib/resolution"] = np.array([width, height])
        if intrinsics is None:
            intrinsics = [0.8 * width, 0.8 * width, (width - 1) / 2, (height - 1) / 2]
        file[f"{group}/calib/intrinsics"] = np.array(intrinsics, float)
    return path


def write_depth(path, depth, times, name="depth/prophesee/left", **filters):
    """M3ED's depth file: maps in metres, infinite without a return, and their times, floats in us."""
    with h5py.File(path, "w") as file:
        chunks = (1, *depth.shape[1:])
        file.create_dataset(
            name, data=depth.astype("f4"), chunks=chunks, **(filters or {"compression": "lzf"})
        )
        file["ts"] = np.asarray(times, "f8")
    return path


def driving_poses(times, speed, turn_rate=0.0, start_us=0):
    """``Cn_T_C0`` of a camera that drives forward at ``speed`` m/s and turns right at ``turn_rate`` rad/s."""
    motions = np.tile(np.eye(4), (len(times), 1, 1))
    for motion, t in zip(motions, (np.asarray(times) - start_us) * 1e-6, strict=True):
        angle = turn_rate * t
        c, s = np.cos(angle), np.sin(angle)
        camera_to_first = np.eye(4)
        camera_to_first[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        way = [speed * t, 0.0] if turn_rate == 0 else [speed / turn_rate * s, speed / turn_rate * (1 - c)]
        camera_to_first[:3, 3] = [way[1], 0, way[0]]
        motion[:] = np.linalg.inv(camera_to_first)
    return motions


def write_poses(path, motions, times, mode="w", camera="/prophesee/left"):
    """M3ED's pose file, or with ``mode="r+"`` the same in its depth file."""
    with h5py.File(path, mode) as file:
        file["Cn_T_C0"] = motions
        file.require_dataset("ts", (len(times),), "f8")[...] = times
        file.attrs["cam_name"] = camera
    return path


BASELINE, RECTIFIED_FOCAL = 0.6, 560.0


def write_calibration(path, shape=DSEC_SHAPE, focal=RECTIFIED_FOCAL, baseline=BASELINE):
    """The part of DSEC's ``cam_to_cam.yaml`` that is read, among some that is not."""
    height, width = shape
    cx, cy = (width - 1) / 2, (height - 1) / 2
    path.write_text(
        "intrinsics:\n"
        "  cam0:\n    camera_model: pinhole\n    camera_matrix: [500.0, 501.0, 300.0, 200.0]\n"
        f"  camRect0:\n    camera_model: pinhole\n    camera_matrix: [{focal}, {focal}, {cx}, {cy}]\n"
        f"    resolution: [{width}, {height}]\n"
        "disparity_to_depth:\n  cams_03:\n"
        f"  - [1.0, 0.0, 0.0, {-cx}]\n  - [0.0, 1.0, 0.0, {-cy}]\n"
        f"  - [0.0, 0.0, 0.0, {focal}]\n  - [0.0, 0.0, {1 / baseline}, 0.0]\n"
    )
    return path


def write_disparity(folder, depth, times, focal=RECTIFIED_FOCAL, baseline=BASELINE):
    """DSEC's ``disparity``: 16-bit pictures, 0 without depth, named by every second image, and times."""
    (folder / "event").mkdir(parents=True)
    for k, metres in enumerate(depth):
        found = metres > 0
        disparity = np.where(found, 256 * focal * baseline / np.where(found, metres, 1), 0)
        Image.fromarray(np.rint(disparity).astype(np.uint16)).save(folder / "event" / f"{2 * k:06}.png")
    (folder / "timestamps.txt").write_text("".join(f"{t}\n" for t in times))
    return folder


def write_rectify_map(path, places):
    """DSEC's ``rectify_map.h5``: column and row of every pixel in the rectified picture."""
    with h5py.File(path, "w") as file:
        file.create_dataset("rectify_map", data=np.asarray(places, "f4"), compression="gzip")
    return path


def write_dat(path, events, shape, version="2", kind=0x0C):
    """DAT: a header, two bytes, and eight bytes per event."""
    words = (events["p"] > 0).astype("u4") << 28 | events["y"].astype("u4") << 14 | events["x"].astype("u4")
    records = np.stack([events["t"].astype("<u4"), words.astype("<u4")], axis=1)
    header = (
        f"% Data file containing CD events\n% Version {version}\n% Width {shape[1]}\n% Height {shape[0]}\n"
    )
    path.write_bytes(header.encode() + bytes([kind, 8]) + records.tobytes())
    return path


def write_evt2(path, events, header=None):
    """RAW, EVT 2.0: a word of the upper 28 bits of the time wherever they change, and one per event."""
    words, high = [], None
    for t, x, y, p in events.tolist():
        if t >> 6 != high:
            high = t >> 6
            words.append(0x8 << 28 | high)
        words.append(int(p > 0) << 28 | (t & 0x3F) << 22 | x << 11 | y)
        words.append(0xA << 28)  # a trigger, which is no event
    header = b"% evt 2.0\n% width 640\n% height 480\n" if header is None else header
    path.write_bytes(header + np.array(words, "<u4").tobytes())
    return path


def write_evt3(path, events, header=None):
    """RAW, EVT 3.0, without vectors: words of time and row where they change, and one per event.

    The upper 12 of 24 bits of the time step up one by one, as cameras send them.
    """
    words, high, low, row = [], -1, None, None
    for t, x, y, p in events.tolist():
        while high < t >> 12:
            high += 1
            words.append(0x8 << 12 | high & 0xFFF)
            low = None
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(0x6 << 12 | low)
        if y != row:
            row = y
            words.append(0x0 << 12 | row)
        words.append(0x2 << 12 | int(p > 0) << 11 | x)
    header = b"% evt 3.0\n% format EVT3;height=480;width=640\n% end\n" if header is None else header
    path.write_bytes(header + np.array(words, "<u2").tobytes())
    return path
