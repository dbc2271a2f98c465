"""Offline data sets in Minari's format."""

import numpy as np
import pytest
from stored_traces import SEEDS, SLICES

from nl_env.evaluation import play
from nl_env.trace_files import default_folder, open_traces
from scripts import collect_minari

minari = pytest.importorskip("minari", reason="an extra of its own")


@pytest.fixture
def command(stored, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return ["--data", str(stored), "--extrapolator", "warp", "--root", str(tmp_path)]


def test_data_sets_hold_what_the_behaviours_did(command, stored, capsys):
    from agents.catalogue import make_policy

    behaviours = ("oracle:30", "event-rate:0.1", "random:0.5")
    assert collect_minari.main([*command, "--obs-mode", "dict", "--behaviour", *behaviours]) == 0
    names = capsys.readouterr().out.splitlines()
    assert names[0] == "nl-env/replay/oracle-30-dict-v0"
    traces = open_traces(default_folder(stored, "warp"))
    for name, behaviour in zip(names, behaviours, strict=True):
        episodes = list(minari.load_dataset(name).iterate_episodes())
        assert len(episodes) == len(SEEDS)
        for episode, (seed, trace) in zip(episodes, traces.items(), strict=True):
            record = play(make_policy(behaviour, seed), trace, behaviour)
            assert tuple(np.flatnonzero(episode.actions) + 1) == record.triggers
            np.testing.assert_array_equal(episode.observations["event_frame"][:SLICES, 0], trace.images[1:])
            assert episode.infos["log_mae"][1:].mean() == pytest.approx(record.held["log_mae"])
            assert episode.truncations.tolist() == [False] * (SLICES - 1) + [True]
            expected = -episode.infos["log_mae"][1:] / 0.05 - 0.1 * episode.actions
            assert episode.rewards == pytest.approx(expected)


def test_the_environment_of_a_data_set_can_be_made_again(command):
    assert collect_minari.main([*command, "--behaviour", "never", "--sequences", "1"]) == 0
    data = minari.load_dataset("nl-env/replay/never-statistics-v0")
    env = data.recover_environment()
    observation, _ = env.reset(seed=SEEDS[0])
    np.testing.assert_array_equal(observation, data[0].observations[0])
    env.close()


def test_data_sets_are_not_written_twice_and_names_are_checked(command, capsys):
    once = [*command, "--behaviour", "never"]
    assert collect_minari.main(once) == 0
    assert collect_minari.main(once) == 2
    assert "found the data set 'nl-env/replay/never-statistics-v0' already" in capsys.readouterr().err
    assert collect_minari.main([*command, "--behaviour", "sound"]) == 2
    assert "'sound'" in capsys.readouterr().err
