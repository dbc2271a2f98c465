"""Keyframe detectors on the same worlds in every weather."""

import json

import numpy as np
import pytest

from nl_env.config import WEATHERS, DrivingConfig, SceneConfig
from nl_env.reproduction.document import cell
from nl_env.reproduction.keyframe_tables import DetectorFile, summarise_keyframes
from nl_env.reproduction.weathers import ScoredWorld, WeatherTask, weather_section, weather_targets
from nl_env.streams import SyntheticStream
from scripts import reproduce

SEED = 7


def active_pixels(frames):
    return np.count_nonzero(frames[:], axis=(1, 2))


def make_scorers():
    return [active_pixels]


def test_a_world_is_the_same_drive_in_every_weather(tmp_path):
    config = DrivingConfig(scene=SceneConfig(duration_s=0.2))
    world = WeatherTask(config, make_scorers)(SEED)
    assert world.scores.shape == (len(WEATHERS), 1, 10)
    assert len(np.unique(world.scores[:, 0, 5])) > 10  # the events differ
    rain = WEATHERS.index("HardRainNoon")
    stream = SyntheticStream(DrivingConfig(scene=SceneConfig(duration_s=0.2, weather="HardRainNoon")))
    stream.reset(SEED)
    frames = [np.clip(stream.advance().event_frame, -128, 127) for _ in range(10)]
    np.testing.assert_array_equal(world.scores[rain, 0], active_pixels(np.array(frames)))

    world.save(tmp_path / "world.npz")
    loaded = ScoredWorld.load(tmp_path / "world.npz")
    assert loaded.seed == SEED
    for name in ("causes", "lidar", "scores"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(world, name))
    assert [one.weather for one in loaded.in_weathers()] == list(WEATHERS)


def test_the_spread_is_that_of_the_weathers():
    """Right everywhere, but for one weather in which half of the keyframes are missed: F1 1 and 2/3."""
    label = np.arange(40) % 2 == 0
    causes = np.stack([label, label, np.zeros(40, bool)], axis=1)
    scores = np.tile(label.astype(float), (len(WEATHERS), 1, 1))
    scores[3, 0, :20] = 0
    world = ScoredWorld(SEED, causes, np.arange(1, 41) % 5 == 0, scores)
    figures = summarise_keyframes({"test": world.in_weathers()}, [DetectorFile("one", 0.5, 0)], 0)
    (target,) = weather_targets(figures, ["one"])
    assert target.value == pytest.approx(1 / 3)
    assert not target.met
    section = weather_section(figures)
    assert section.rows[4][:2] == [WEATHERS[3], cell(2 / 3, 3)]
    assert section.rows[-1][1] == cell(1 / 3, 2)


def test_the_command_measures_and_refuses(tmp_path, capsys):
    options = ["table-weather", "--duration", "0.2", "--workers", "0", "--out", str(tmp_path / "out")]
    assert reproduce.main([*options, "--worlds", "1"]) == 0
    assert "HardRainSunset" in capsys.readouterr().out
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert set(WEATHERS) <= set(results["figures"]["weathers"])
    assert reproduce.main([*options, "--worlds", "0", "--overwrite"]) == 2
    assert "worlds: found 0" in capsys.readouterr().err
    assert reproduce.main([*options, "--weights", "--temporal-weights", "--overwrite"]) == 2
    assert "weights: found no detector" in capsys.readouterr().err
