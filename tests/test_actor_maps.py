import numpy as np
import pytest

from agents.actor_maps import _cells, actor_maps, grid
from agents.keyframe_networks import RANGES
from nl_env.config import SPLITS, DrivingConfig, SceneConfig
from nl_env.recording import Recording, record_sequence
from nl_env.scene.scene import camera_pose
from nl_env.types import Camera

CAMERA = Camera.from_fov(120, 160, 75.0)
CAR = (4.0, 1.8, 1.6)
POSE = camera_pose((0.0, 0.0, 2.4), 0.0, 0.0, 0.0)


def cells(x, y, heading=0.0):
    """Cells of a car at (x, y) m, x ahead and y to the left of a camera 2.4 m above the ground."""
    rows, columns = _cells(np.array([x, y, heading, 0.0]), CAR, POSE, CAMERA)
    return range(rows.start, rows.stop), range(columns.start, columns.stop)


def test_a_car_ahead_covers_the_cells_its_box_projects_to():
    rows, columns = cells(10.0, 0.0)
    # Its near end is 8 m ahead: 1.8 m at 104 px of focal length are 23 px, around column 79.5.
    half = 0.9 / 8 * CAMERA.fx
    assert columns == range(int((80 - half) // 8), int(-(-(80 + half) // 8)))
    # The roof's far end (0.8 m below the camera, 12 m ahead) to the near lower edge (2.4 m below, 8 m ahead).
    top, bottom = (60 + down / ahead * CAMERA.fy for down, ahead in ((0.8, 12.0), (2.4, 8.0)))
    assert rows == range(int(top // 8), int(-(-bottom // 8)))


def test_nearer_is_larger_and_left_is_left():
    near, far = cells(8.0, 0.0), cells(30.0, 0.0)
    assert len(near[0]) * len(near[1]) > len(far[0]) * len(far[1]) >= 1
    assert cells(12.0, 4.0)[1].stop <= cells(12.0, -4.0)[1].start


@pytest.mark.parametrize("place", [(-8.0, 0.0), (5.0, 30.0), (5.0, -30.0)])
def test_cars_behind_and_beside_cover_nothing(place):
    rows, columns = cells(*place)
    assert not (len(rows) and len(columns))


def test_maps_agree_with_the_recorded_distance(tmp_path):
    seed = SPLITS["train"][1]
    config = DrivingConfig(resolution="quarter", scene=SceneConfig(scenario="intersection", duration_s=0.4))
    record_sequence(tmp_path / "one.h5", config, seed)
    with Recording(tmp_path / "one.h5") as recording:
        maps = actor_maps(recording)
        distance = recording.shortest_distance[1:]
    assert maps.shape == (recording.slices, len(RANGES), *grid((120, 160))) == (20, 2, 15, 20)
    assert not np.any(maps[:, 0] & ~maps[:, 1])  # what is within 8 m is within 20 m
    for level, limit in enumerate(RANGES):
        assert not np.any(maps[distance >= limit, level])
