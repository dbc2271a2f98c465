"""Work in two threads gives what one thread gives, and the threads come and go with their process."""

import multiprocessing
import threading

import numpy as np
import pytest
import torch
from analytic_stream import WallStream

from nl_env.depth.features import Scene, features
from nl_env.depth.learned import MotionWarpRefine
from nl_env.depth.motion import se3_exp
from nl_env.depth.refine_answer import depth_frames
from nl_env.depth.threads import WORTH, together, usable_threads
from nl_env.types import Camera, ExtrapolationInput

CAMERA = Camera.from_fov(120, 160, 75.0)


def scene():
    rng = np.random.default_rng(0)
    prior, previous = rng.uniform(0, 250, (2, *CAMERA.shape)).astype(np.float32)
    voxel = rng.integers(-9, 10, (5, *CAMERA.shape)).astype(np.float32)
    return Scene(CAMERA, 200.0, prior, previous, se3_exp(rng.normal(0, 0.1, 6)), voxel, 0.06)


def test_the_first_task_runs_here_and_the_others_beside_it():
    met = threading.Barrier(2, timeout=20)
    ran = {}

    def task(name):
        met.wait()  # passes only if both run at once
        ran[name] = threading.get_ident()

    together([lambda: task("first"), lambda: task("second")], 2)
    assert ran["first"] == threading.get_ident() != ran["second"]


def test_one_thread_keeps_the_order_and_makes_no_other():
    ran = []
    before = threading.active_count()
    together([lambda: ran.append(1), lambda: ran.append(threading.active_count())], 1)
    assert ran == [1, before]


@pytest.mark.parametrize("failing", [0, 1])
def test_what_a_task_raises_arrives_when_all_have_ended(failing):
    ended = []

    def fail():
        raise ZeroDivisionError

    tasks = [lambda: ended.append(True)] * 2
    tasks[failing] = fail
    with pytest.raises(ZeroDivisionError):
        together(tasks, 2)
    assert ended == [True]
    together([lambda: ended.append(True)] * 2, 2)
    assert len(ended) == 3


def test_a_forked_process_makes_threads_of_its_own():
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("no fork here")
    together([list, list], 2)  # this process has its own now
    process = multiprocessing.get_context("fork").Process(target=together, args=([list, list], 2))
    process.start()
    process.join(20)
    assert process.exitcode == 0


def test_threads_follow_the_image_the_environment_and_pytorch(monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 8)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    large, small = (120, WORTH // 120), (8, 8)
    assert (usable_threads(large, 4), usable_threads(small, 4), usable_threads(large)) == (4, 1, 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    assert usable_threads(large, 4) == 1


@pytest.mark.parametrize("compensated", [False, True])
def test_features_do_not_depend_on_threads(compensated):
    motion = se3_exp(np.array([0.1, 0.0, -1.0, 0.0, 0.02, 0.0]))
    alone = features(scene(), motion, compensated=compensated)
    out = np.full_like(alone, np.nan)
    assert features(scene(), motion, compensated=compensated, threads=2, out=out) is out
    np.testing.assert_array_equal(out, alone)
    with pytest.raises(ValueError, match="out"):
        features(scene(), motion, out=out[:, ::2])


def test_depth_frames_do_not_depend_on_threads():
    answer = np.random.default_rng(0).normal(0, 2, (3, *CAMERA.shape)).astype(np.float32)
    for one, two in zip(depth_frames(answer, 200.0), depth_frames(answer, 200.0, threads=2), strict=True):
        np.testing.assert_array_equal(one, two)


def test_an_extrapolator_gives_the_same_bytes_with_any_number_of_threads(monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 8)
    monkeypatch.setattr("nl_env.depth.threads.WORTH", 1)
    stream = WallStream(speed=15.0)
    samples = [stream.reset(0)] + [stream.advance() for _ in range(stream.slices)]
    given = ExtrapolationInput(
        samples[13].t,
        stream.camera,
        stream.max_depth,
        tuple(samples[k].depth for k in (5, 10)),
        tuple(samples[k].t for k in (5, 10)),
        tuple(sample.bins for sample in samples[11:14]),
        (),
    )

    def first_channels(stack):
        return (np.ascontiguousarray(stack[:, :3]),)

    one, two = (MotionWarpRefine(None, first_channels, threads=n)(given) for n in (1, 2))
    np.testing.assert_array_equal(one.depth, two.depth)
    np.testing.assert_array_equal(one.depth_if_return, two.depth_if_return)
