"""``nl_env/Replay-v0`` with ``errors="table"``: what the full computation gives, without it."""

import pickle
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from rollouts import digest, rollout
from short_recordings import record
from stored_traces import SEEDS, SLICES, store

import nl_env  # noqa: F401 - registers the environments
from nl_env.depth.extrapolators import Warp
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.observations import OBS_MODES
from nl_env.replay import ReplayEnv
from nl_env.trace_files import default_folder, trace_files

ROOT = Path(__file__).parents[1]


def replay(data, errors="table", **arguments):
    return ReplayEnv(data=data, extrapolator="warp", errors=errors, **arguments)


@pytest.mark.parametrize("obs_mode", OBS_MODES)
def test_every_byte_equals_the_full_computation(stored, obs_mode):
    table, computed = replay(stored, obs_mode=obs_mode), replay(stored, "compute", obs_mode=obs_mode)
    for seed in (*SEEDS, 123):
        expected = digest(rollout(computed, seed, steps=SLICES))
        assert digest(rollout(table, seed, steps=SLICES)) == expected


@pytest.mark.parametrize("error", METRIC_NAMES)
def test_every_metric_gives_the_computed_reward(stored, error):
    rng = np.random.default_rng(0)
    table, computed = replay(stored, error=error), replay(stored, "compute", error=error)
    for env in (table, computed):
        env.reset(seed=SEEDS[0])
    for action in rng.integers(2, size=SLICES):
        found, expected = table.step(action), computed.step(action)
        assert found[1:4] == expected[1:4] and repr(found[4]) == repr(expected[4])


def test_costs_that_are_drawn_are_the_computed_ones(stored):
    arguments = {"obs_mode": "dict", "trigger_cost": (0.01, 1.0)}
    table, computed = replay(stored, **arguments), replay(stored, "compute", **arguments)
    starts = [digest(rollout(env, 3, SLICES) + rollout(env, None, SLICES)) for env in (table, computed)]
    assert starts[0] == starts[1]


@pytest.mark.parametrize("obs_mode", OBS_MODES)
def test_check_env_is_clean(stored, obs_mode):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(replay(stored, obs_mode=obs_mode), skip_render_check=True)


def test_it_pickles_in_the_middle_of_an_episode(stored):
    env = replay(stored)
    env.reset(seed=0)
    env.step(1)
    copy = pickle.loads(pickle.dumps(env))
    assert len(pickle.dumps(env)) < 200_000  # paths and counters, no tables
    left, right = env.step(1), copy.step(1)
    assert digest([(left[0], left[1], left[4])]) == digest([(right[0], right[1], right[4])])


def test_there_are_no_depth_frames_and_that_is_said(stored):
    env = replay(stored)
    env.reset(seed=SEEDS[0])
    for what in ("depth", "prior_depth", "true_depth"):
        with pytest.raises(RuntimeError, match=r"stored traces hold errors .* errors='compute'"):
            getattr(env, what)
    for what in ("depth", "lidar", "bins"):
        with pytest.raises(RuntimeError, match=f"{what}: stored traces"):
            getattr(env.sample, what)
    with pytest.raises(RuntimeError, match="intensity: stored traces"):
        env.stream.intensity()
    with pytest.raises(ValueError, match="render_mode: found 'rgb_array' with errors='table'"):
        replay(stored, render_mode="rgb_array")
    assert env.stream.describe()["scenario"] == "highway"


def test_no_network_is_loaded(stored):
    code = (
        "import sys, gymnasium, nl_env;"
        f"env = gymnasium.make('nl_env/Replay-v0', data={str(stored)!r}, extrapolator='warp', "
        "errors='table'); env.reset(seed=7); env.step(1);"
        "print('torch' in sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert result.stdout.strip() == "False"


def test_another_lidar_has_tables_of_its_own(stored, tmp_path):
    out = tmp_path / "tables"
    assert store(stored, "--lidar-hz", "25", "--beams", "32", "--out", str(out)) == 0
    lidar = {"lidar_hz": 25, "beams": 32}
    table, computed = replay(stored, tables=out, **lidar), replay(stored, "compute", **lidar)
    seed = SEEDS[1]
    assert digest(rollout(table, seed, SLICES)) == digest(rollout(computed, seed, SLICES))
    for arguments, message in (
        ({"tables": out}, "lidar_hz is 25, expected 10; beams is 32, expected 0"),
        (lidar, "lidar_hz is 10, expected 25; beams is 0, expected 32"),
    ):
        with pytest.raises(ValueError, match=message):
            replay(stored, **arguments)


def test_what_does_not_fit_is_refused(stored, tmp_path):
    tables = default_folder(stored, "warp")
    for arguments, kind, message in (
        ({"errors": "tables"}, ValueError, "errors: found 'tables', expected one of 'compute', 'table'"),
        ({"errors": "compute", "tables": tables}, ValueError, "tables: found .* with errors='compute'"),
        ({"odometry": True, "tables": tables}, ValueError, "odometry is False, expected True"),
        ({"tables": tmp_path}, FileNotFoundError, "found no SEED.safetensors"),
        ({"tables": tmp_path / "nowhere"}, FileNotFoundError, r"nowhere; make them with scripts/precompute"),
    ):
        with pytest.raises(kind, match=message):
            replay(stored, **arguments)
    with pytest.raises(FileNotFoundError, match="data-tables-repeat"):
        ReplayEnv(data=stored, extrapolator="repeat", errors="table")
    with pytest.raises(ValueError, match="extrapolator is 'warp', expected 'repeat'"):
        ReplayEnv(data=stored, extrapolator="repeat", errors="table", tables=tables)
    with pytest.raises(TypeError, match="expected a name or a path to weights"):
        ReplayEnv(data=stored, extrapolator=Warp(), errors="table")
    with pytest.raises(ValueError, match="seed: found 5, expected one of the 2 recorded"):
        replay(stored).reset(options={"sequence": 5})


def test_missing_truncated_and_outdated_tables_are_refused(stored, tmp_path):
    tables = tmp_path / "tables"
    shutil.copytree(default_folder(stored, "warp"), tables)
    first, second = trace_files(tables).values()
    second.unlink()
    with pytest.raises(FileNotFoundError, match=rf"found no trace of 1 of 2 recordings .*{SEEDS[1]}"):
        replay(stored, tables=tables)
    replay(stored, tables=tables, sequences=[SEEDS[0]]).reset(seed=0)  # the others are not needed
    whole = first.read_bytes()
    first.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(
        ValueError, match=rf"{first.name}: found {len(whole) // 2} bytes, expected {len(whole)}"
    ):
        replay(stored, tables=tables, sequences=[SEEDS[0]])
    first.write_bytes(whole)
    env = replay(record(tmp_path / "other", SEEDS[:1], 0.2), tables=tables)
    with pytest.raises(ValueError, match=rf"{first.name}: found a trace of something else: recording is"):
        env.reset(seed=0)


def test_tables_of_other_weights_are_refused(stored, tmp_path):
    from nl_env.depth.extrapolators import WEIGHTS

    weights = tmp_path / "mine.safetensors"
    for suffix in (".safetensors", ".json"):
        shutil.copy((WEIGHTS / "unet").with_suffix(suffix), weights.with_suffix(suffix))
    one = ["--sequences", "1", "--out", str(tmp_path / "tables")]
    assert store(stored, *one, extrapolator=str(weights)) == 0
    arguments = {"data": stored, "sequences": [SEEDS[0]], "errors": "table", "tables": tmp_path / "tables"}
    table = ReplayEnv(extrapolator="unet", **arguments)  # the same weights under another name
    computed = ReplayEnv(data=stored, sequences=[SEEDS[0]], extrapolator="unet")
    found, expected = (rollout(env, 0, steps=6) for env in (table, computed))
    for (_, left, _), (_, right, _) in zip(found, expected, strict=True):
        assert left == pytest.approx(right, abs=1e-6)
    weights.with_suffix(".json").unlink()
    with pytest.raises(ValueError, match=r"found a trace of something else: weights is"):
        ReplayEnv(extrapolator=str(weights), **arguments)
