import json
from itertools import pairwise

import pytest

from nl_env.config import (
    SPLITS,
    DrivingConfig,
    EventCameraConfig,
    LidarConfig,
    SceneConfig,
    from_dict,
    to_dict,
)


def test_json_round_trip():
    config = DrivingConfig(
        resolution="half",
        scene=SceneConfig(scenario="merge", duration_s=3.0),
        events=EventCameraConfig.preset("ideal"),
        lidar=LidarConfig(rate_hz=5, beams=32),
    )
    assert from_dict(DrivingConfig, json.loads(json.dumps(to_dict(config)))) == config


def test_unknown_key_lists_the_valid_ones():
    values = to_dict(DrivingConfig())
    values["scene"]["wheather"] = "ClearNoon"
    with pytest.raises(ValueError, match=r"SceneConfig key: found 'wheather'.*'weather'"):
        from_dict(DrivingConfig, values)


@pytest.mark.parametrize(
    ("make", "valid"),
    [
        (lambda: DrivingConfig(resolution="huge"), "'quarter'"),
        (lambda: SceneConfig(scenario="desert"), "'roundabout'"),
        (lambda: SceneConfig(style="alpine"), "'suburb'"),
        (lambda: SceneConfig(weather="Snow"), "'HardRainSunset'"),
        (lambda: EventCameraConfig.preset("noisy"), "'realistic'"),
        (lambda: LidarConfig(rate_hz=7), "10"),
        (lambda: LidarConfig(beams=3), "64"),
        (lambda: SceneConfig(duration_s=float("nan")), "finite"),
        (lambda: SceneConfig(duration_s="20"), "finite"),
        (lambda: SceneConfig(duration_s=0.0), r"\[0.2"),
        (lambda: EventCameraConfig(threshold_on=-0.1), "threshold_on"),
    ],
)
def test_bad_values_name_what_is_valid(make, valid):
    with pytest.raises(ValueError, match=valid):
        make()


def test_slices_and_lidar_period():
    assert SceneConfig(duration_s=20.0).slices == 1000
    assert [LidarConfig(rate_hz=rate).period for rate in (1, 2, 5, 10, 25)] == [50, 25, 10, 5, 2]


def test_splits_are_disjoint_and_fit_32_bits():
    edges = [(split.start, split.stop) for split in SPLITS.values()]
    assert edges[0][0] == 0 and edges[-1][1] == 2**31
    assert all(left[1] == right[0] for left, right in pairwise(edges))
