"""Realism measurements: pairs against the event list, averages of hand-made worlds, and the command."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from nl_env.config import DrivingConfig, EventCameraConfig, SceneConfig
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.realism import published
from nl_env.realism.network import CONTROLS, symmetric_divergence
from nl_env.realism.published import GAPS_MS
from nl_env.realism.summary import clustered_mean, effective_rate, summarise
from nl_env.realism.tables import markdown
from nl_env.realism.targets import targets
from nl_env.realism.world import WARM_UP_SLICES, WorldReport, WorldTask, depth_pair, events_pair, measure
from nl_env.representations import voxel_grid
from nl_env.scene.scene import DrivingScene
from nl_env.sensors.event_camera import EventCamera
from nl_env.types import SLICE_US, TICK_US
from scripts import realism

CONFIG = DrivingConfig(resolution="quarter", scene=SceneConfig(scenario="two-way", duration_s=1.0))
START = 200_000
METRICS, GAPS = len(METRIC_NAMES), len(GAPS_MS)


@pytest.fixture(scope="module")
def scene():
    return DrivingScene(CONFIG.scene, CONFIG.camera, 3)


@pytest.fixture(scope="module")
def pair(scene):
    return events_pair(CONFIG, scene, START, np.random.default_rng(5))


def test_voxels_and_active_pixels_are_those_of_the_event_list(scene, pair):
    camera = EventCamera(CONFIG.events, CONFIG.camera.shape)
    camera.noise_scale = scene.noise_scale
    intensity = np.zeros(CONFIG.camera.shape, np.float32)
    first = START - WARM_UP_SLICES * SLICE_US
    scene.render(first, intensity)
    camera.reset(intensity, first, np.random.default_rng(5))
    listed = []
    for t in range(first + TICK_US, START + GAPS_MS[-1] * 1000 + 1, TICK_US):
        scene.render(t, intensity)
        listed.append(camera.events(intensity, t))
    events = np.concatenate(listed)
    for gap, voxel, active in zip(GAPS_MS, pair.voxels, pair.active, strict=True):
        end = START + gap * 1000
        np.testing.assert_array_equal(voxel, voxel_grid(events, CONFIG.camera.shape, START, end))
        inside = events[(events["t"] >= START) & (events["t"] < end)]
        share = np.unique(inside["y"].astype(int) * CONFIG.camera.width + inside["x"]).size / voxel[0].size
        # Opposite events of a pixel within one tick cancel.
        assert 0.97 * share <= active <= share


def test_depth_is_the_same_with_and_without_events(scene, pair):
    alone = depth_pair(CONFIG, scene, START, np.random.default_rng(5))
    np.testing.assert_array_equal(alone.prior, pair.prior)
    for one, other in zip(alone.truths, pair.truths, strict=True):
        np.testing.assert_array_equal(one, other)
    assert not alone.voxels and np.isnan(alone.active).all()


def test_figures_of_a_pair_with_a_known_answer(pair):
    """The left half recedes by 2 m; a tenth of the right half appears out of the sky."""
    prior = np.full((10, 20), 10.0, np.float32)
    prior[:, 10] = 0.0
    truth = np.full((10, 20), 10.0, np.float32)
    truth[:, :10] = 12.0
    found = measure(
        replace(pair, prior=prior, truths=[truth] * GAPS, voxels=[np.ones((5, 10, 20))] * GAPS), 200.0
    )
    assert found["prior_sky"] == [0.05] * GAPS
    assert found["depth_change"] == pytest.approx([100 * 2.0 / 190] * GAPS)
    assert found["no_return"] == 0.05
    assert found["depth_moments"] == (9.5, 95.0)
    assert found["border"] == (9.5, 9.5, 10.0, 10.0)
    assert found["steps"] == pytest.approx([100 * 2 / 19, 100 * 2 / 18])
    np.testing.assert_array_equal(found["bins"], np.ones((GAPS, 3)))


def test_world_task_is_deterministic_and_survives_its_file(tmp_path):
    task = WorldTask(CONFIG, pairs=2, events=False)
    first, again = task(3), task(3)
    first.save(tmp_path / "3.npz")
    loaded = WorldReport.load(tmp_path / "3.npz")
    for name, value in vars(first).items():
        np.testing.assert_array_equal(value, getattr(again, name))
        np.testing.assert_array_equal(value, getattr(loaded, name))
    assert first.description[0] == "two-way" and first.keyframes.shape == (50, 3)
    assert (np.diff(first.repeat[:, :, 0].mean(axis=0)) > 0).all()  # the error grows with the gap
    assert np.isnan(first.network).all() and first.probed == 0


def hand_made(seed, scale, speed_kmh, share, description=("highway", "rural", "ClearNoon")):
    """A world whose Repeat row is the paper's times ``scale`` and whose first slices are keyframes."""
    row = np.array([[*published.REPEAT[gap], *np.zeros(METRICS - 7)] for gap in GAPS_MS])
    keyframes = np.zeros((100, 3), bool)
    keyframes[: round(100 * share), 0] = True
    keyframes[: round(50 * share), 2] = True
    pairs = 2
    return WorldReport(
        seed=seed,
        description=description,
        speed=np.full(pairs, speed_kmh / 3.6),
        repeat=np.tile(scale * row, (pairs, 1, 1)),
        network=np.full((pairs, GAPS, len(CONTROLS), METRICS), np.nan),
        prior_sky=np.tile([published.PRIOR_SKY[gap] for gap in GAPS_MS], (pairs, 1)),
        depth_change=np.full((pairs, GAPS), speed_kmh / 25),
        no_return=np.full(pairs, 0.3),
        depth_moments=np.full((pairs, 2), (14.0, 14.0**2 + 24.0**2)),
        border=np.ones((pairs, 4)),
        steps=np.full((pairs, 2), (7.4**2, 9.2**2)),
        active=np.full((pairs, GAPS), np.nan),
        bins=np.full((pairs, GAPS, 3), np.nan),
        keyframes=keyframes,
        moments=np.zeros((GAPS, 0, 0, 2)),
        probed=0,
    )


WORLDS = [hand_made(0, 0.9, 8.0, 0.5), hand_made(1, 1.1, 60.0, 1.0, ("exit", "rural", "ClearNoon"))]


def test_summary_of_two_hand_made_worlds():
    summary = summarise(WORLDS)
    for row in summary.gaps:
        known = published.REPEAT[row.gap_ms][0]
        assert row.repeat["rmse"].value == pytest.approx(known)
        assert row.repeat["rmse"].error == pytest.approx(0.1 * known)
    slow, *between, fast = summary.speeds
    assert (slow.pairs, fast.pairs) == (2, 2) and not any(row.pairs for row in between)
    assert slow.depth_change[2].value == pytest.approx(0.32)
    assert fast.depth_change[2].value == pytest.approx(2.4)
    assert summary.statistics["depth standard deviation, sky = 0 (m)"] == pytest.approx(24.0)
    assert summary.statistics["RMS difference of neighbours, 1 px (m)"] == pytest.approx(7.4)
    assert [(g.name, g.worlds) for g in summary.groups] == [("exit", 1), ("highway", 1), ("rural", 2)]
    keyframes = summary.keyframes
    assert keyframes.causes == pytest.approx({"speed": 1.0, "distance": 0.0, "new actor": 0.5})
    assert keyframes.alone == pytest.approx({"speed": 0.5, "distance": 0.0, "new actor": 0.0})
    assert (keyframes.rate_min, keyframes.rate_max) == (30.0, 50.0)
    assert keyframes.rate.value == pytest.approx(40.0)


def test_targets_are_met_missed_or_not_measured():
    found = {target.name: target for target in targets(summarise(WORLDS))}
    assert all(target.met for name, target in found.items() if name.startswith(("Repeat", "prior", "depth")))
    assert found["mean effective rate under the rule (Hz)"].met
    assert found["least rise of active pixels from one window to the next"].met is None
    worse = {target.name: target for target in targets(summarise([hand_made(0, 1.2, 60.0, 1.0)]))}
    assert worse["Repeat RMSE, 20 ms (m)"].met is False
    assert worse["mean effective rate under the rule (Hz)"].met is False
    assert worse["depth change over 100 ms, below 10 km/h (m)"].met is None


def test_tables_show_ours_beside_the_paper_and_nothing_that_was_not_measured():
    text = markdown(summarise(WORLDS))
    assert "| 20 | 4.98 ± 0.50 (4.976, +0 %)" in text
    assert "nan" not in text and "checkpoint, unchanged" not in text


def test_mean_and_standard_error_over_worlds():
    worlds = [np.array([1.0, 3.0]), np.array([4.0, 6.0]), np.array([np.nan, 8.0, 8.0])]
    found = clustered_mean(worlds)
    means = np.array([2.0, 5.0, 8.0])
    assert found.value == pytest.approx(5.0)
    assert found.error == pytest.approx(means.std(ddof=1) / math.sqrt(3))
    unequal = clustered_mean([np.array([1.0]), np.array([4.0, 4.0, 4.0])])
    assert unequal.value == pytest.approx(3.25)
    assert unequal.error == pytest.approx(math.sqrt(2 * 2 * 2.25**2) / 4)
    assert math.isnan(clustered_mean([np.array([1.0, 2.0])]).error)
    assert math.isnan(clustered_mean([np.array([np.nan])]).value)
    with pytest.raises(ValueError, match="reports"):
        summarise([])


def test_effective_rate_counts_lidar_frames_once():
    keyframes = np.zeros(1000, bool)
    assert effective_rate(keyframes, lidar_period=5) == 10.0
    keyframes[4::5] = True  # slices 5, 10, ... have a LiDAR frame anyway
    assert effective_rate(keyframes, lidar_period=5) == 10.0
    assert effective_rate(~keyframes, lidar_period=5) == 50.0


def test_divergence_of_known_gaussians():
    found = symmetric_divergence(*(np.array(v, float) for v in ([0, 0, 3], [1, 1, 2], [1, 0, 3], [1, 4, 2])))
    np.testing.assert_allclose(found, [1.0, 1.125, 0.0])


def test_checkpoint_statistics_are_those_of_its_inputs(pair, tmp_path):
    torch = pytest.importorskip("torch")
    from nl_env.depth.unet import UNet
    from nl_env.realism.network import ReleasedProbe, batch_norm_distance

    torch.manual_seed(0)
    network = UNet()
    path = str(tmp_path / "network.pth")
    torch.save(network.state_dict(), path)
    probe = ReleasedProbe(path, GAPS)
    for gap, voxel in enumerate(pair.voxels):
        depths = probe.predict(pair.prior, voxel, gap)
        assert len(depths) == len(CONTROLS) and all(d.shape == pair.prior.shape for d in depths)
        assert all((d != depths[0]).any() for d in depths[1:])

    with torch.no_grad():
        seen = [network.event_stem.depthwise(torch.from_numpy(voxel)[None])[0] for voxel in pair.voxels]
    for gap, x in enumerate(seen):
        expected = torch.stack([x.mean((1, 2)), (x * x).mean((1, 2))], dim=1)
        np.testing.assert_allclose(probe.moments[gap, 0, :5], expected, rtol=1e-3, atol=1e-5)

    # Running statistics equal to what arrives make the distance of that layer zero.
    before = dict(batch_norm_distance(path, probe.moments, 1))
    mean, square = probe.moments[:, 0, :5].mean(axis=0).T
    network.event_stem.bn1.running_mean[:] = torch.from_numpy(mean)
    network.event_stem.bn1.running_var[:] = torch.from_numpy(square - mean**2)
    torch.save(network.state_dict(), path)
    after = dict(batch_norm_distance(path, probe.moments, 1))
    assert len(after) == 31
    assert before["event_stem.bn1"] > 1e-2 and after["event_stem.bn1"] < 1e-9
    assert before["depth_stem.bn"] == after["depth_stem.bn"]
    with pytest.raises(ValueError, match="probed"):
        batch_norm_distance(path, probe.moments, 0)


@pytest.fixture
def small(monkeypatch):
    """The command on a quarter-resolution second instead of twenty at full resolution."""
    config = replace(CONFIG, events=EventCameraConfig.preset("ideal"))
    monkeypatch.setattr(realism.Settings, "config", property(lambda settings: config))


def run(folder, *more):
    return realism.main(["--worlds", "2", "--pairs", "1", "--workers", "0", "--out", str(folder), *more])


def test_the_command_writes_results_tables_and_plots(small, tmp_path, capsys):
    document = tmp_path / "realism.md"
    document.write_text(f"before\n\n{realism.BEGIN}\nold\n{realism.END}\n\nafter\n")
    assert run(tmp_path / "run", "--markdown", str(document)) == 0
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {
        "results.json",
        "table.md",
        "settings.json",
        "sequences",
        "depth_change.png",
        "event_change.png",
    }
    found = json.loads((tmp_path / "run" / "results.json").read_text())
    assert [world["seed"] for world in found["sequences"]] == [2_000_000_000, 2_000_000_001]
    assert found["batch_norms"] is None and 0 < found["gaps"][0]["active"]["value"] < 1
    text = document.read_text()
    assert text.startswith("before\n") and text.endswith("\n\nafter\n") and "old" not in text
    assert (
        "images/depth_change.png" in text and "## Targets" in text and "## Targets" in capsys.readouterr().out
    )

    results = (tmp_path / "run" / "results.json").read_bytes()
    (tmp_path / "run" / "sequences" / "2000000000.npz").unlink()
    assert run(tmp_path / "run") == 2
    assert "already holds another run" in capsys.readouterr().err
    assert run(tmp_path / "run", "--resume") == 0
    assert (tmp_path / "run" / "results.json").read_bytes() == results


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--worlds", "0"], "worlds: found 0"),
        (["--control-pairs", "5", "--network-pairs", "2"], "control_pairs: found 5"),
        (["--checkpoint", "nowhere.pth"], "nowhere.pth"),
        (["--noise", "some"], "noise: found 'some'"),
    ],
)
def test_wrong_options_are_refused_before_the_work(arguments, message, tmp_path, capsys):
    assert run(tmp_path / "run", *arguments) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_document_without_marks_is_refused_before_the_work(tmp_path, capsys):
    document = tmp_path / "realism.md"
    document.write_text("words\n")
    assert run(tmp_path / "run", "--markdown", str(document)) == 2
    assert "markdown: found no" in capsys.readouterr().err
    assert document.read_text() == "words\n" and not (tmp_path / "run").exists()
