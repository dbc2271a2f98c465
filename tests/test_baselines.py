import math
import subprocess
import sys

import numpy as np
import pytest

from nl_env.depth import baselines
from nl_env.depth.extrapolators import Warp, make_extrapolator
from nl_env.types import Camera, DepthExtrapolator, Extrapolation, ExtrapolationInput

RANGE = 200.0
CAMERA = Camera.from_fov(1, 4, 70.0)


def image(*values):
    return np.array([values], np.float32)


def inputs(*frames, gap_ms=50, **kwargs):
    times = [100_000 * k for k in range(len(frames))]
    return ExtrapolationInput(times[-1] + 1000 * gap_ms, CAMERA, RANGE, frames, times, [], **kwargs)


def test_linear_continues_a_line_through_time():
    # Approaching at 20 m/s, receding at 10 m/s, still: 50 ms later another half of the change.
    predicted = baselines.linear(image(22, 9, 40), image(20, 10, 40), 0.1, 0.05, RANGE)
    assert predicted.tolist() == image(19, 10.5, 40).tolist()
    assert predicted.dtype == np.float32


def test_linear_stays_between_touching_and_the_range():
    predicted = baselines.linear(image(3, 150), image(1, 199), 0.1, 0.1, RANGE)
    assert predicted[0, 0] == np.float32(1e-8) and predicted[0, 1] == RANGE


def test_exponential_is_the_papers_formula_with_seconds():
    previous, last = image(11, 30), image(10, 30)
    predicted = baselines.exponential(previous, last, 0.1, 0.05, RANGE)
    expected = [10 * math.exp(0.05 * 10 - 0.1 * 11), 30 * math.exp(-0.05 * 30)]
    assert predicted[0].tolist() == pytest.approx(expected, rel=1e-6)


def test_exponential_overflow_ends_at_the_range():
    assert baselines.exponential(image(1), image(190), 0.1, 5.0, RANGE)[0, 0] == RANGE


@pytest.mark.parametrize("method", [baselines.linear, baselines.exponential])
def test_holes_keep_the_last_frame(method):
    previous, last = image(0, 50, 0), image(30, 0, 0)
    assert method(previous, last, 0.1, 0.05, RANGE).tolist() == last.tolist()


@pytest.mark.parametrize("name", ["repeat", "linear", "exponential", "warp"])
def test_first_frame_is_repeated(name):
    frame = image(5, 10, 0, 40)
    extrapolator = make_extrapolator(name)
    assert isinstance(extrapolator, DepthExtrapolator)
    assert extrapolator(inputs(frame)).depth.tolist() == frame.tolist()


def test_names_reach_their_method_with_the_right_times():
    frames = image(22, 9, 40, 10), image(20, 10, 40, 10)
    for name in ("linear", "exponential"):
        expected = getattr(baselines, name)(*frames, 0.1, 0.02, RANGE)
        assert make_extrapolator(name)(inputs(*frames, gap_ms=20)).depth.tolist() == expected.tolist()
    assert make_extrapolator("repeat")(inputs(*frames)).depth.tolist() == frames[1].tolist()


def test_odometry_is_for_warp():
    assert make_extrapolator("warp", odometry=True).odometry
    assert not make_extrapolator("repeat", odometry=True).odometry


def test_an_extrapolator_of_ones_own_is_taken_as_it_is():
    class Wall:
        history = 1
        odometry = False

        def reset(self): ...

        def __call__(self, inputs):
            return Extrapolation(np.full_like(inputs.lidar_frames[-1], 7))

    wall = Wall()
    assert make_extrapolator(wall) is wall
    for wrong in (Warp, None, 3):
        with pytest.raises(TypeError, match="expected a name, a path or a DepthExtrapolator"):
            make_extrapolator(wrong)


def test_unknown_names_and_missing_weights_say_what_to_do(tmp_path):
    with pytest.raises(ValueError, match="'wrap', expected one of repeat, linear, exponential, warp, unet"):
        make_extrapolator("wrap")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.pth"):
        make_extrapolator(tmp_path / "nowhere.pth")


def test_missing_shipped_weights_are_named(monkeypatch, tmp_path):
    monkeypatch.setattr("nl_env.depth.extrapolators.WEIGHTS", tmp_path)
    for name in ("unet", "unet-paper"):
        with pytest.raises(FileNotFoundError, match=f"nl_env/weights/{name}.safetensors.*give a path.*warp"):
            make_extrapolator(name)


def test_torch_is_not_imported_before_a_network_is_made():
    code = "import sys, nl_env.depth.extrapolators; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
