"""The networks and the policy; their data and training are in test_keyframe_training.py."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from agents.keyframe_cnn import KeyframeCNN, average_down, limited_threads, load_detector, probability
from agents.keyframe_networks import FrameDetector, TemporalDetector
from nl_env.observations import make_observation, state_vector
from nl_env.training import seeded
from nl_env.weight_files import Card, write_weights

SIZE = (32, 40)
STATE = state_vector(0.2, 0.2, 10, 2000, 0)

RELEASED_SHAPES = {
    **{f"conv{i}.weight": shape for i, shape in ((1, (16, 1, 3, 3)), (2, (8, 16, 3, 3)), (3, (4, 8, 3, 3)))},
    **{f"conv{i}.bias": (n,) for i, n in ((1, 16), (2, 8), (3, 4))},
    **{
        f"bn{i}.{name}": (n,)
        for i, n in ((1, 16), (2, 8), (3, 4))
        for name in ("weight", "bias", "running_mean", "running_var")
    },
    **{f"bn{i}.num_batches_tracked": () for i in (1, 2, 3)},
    "fc1.bias": (128,),
    "fc2.weight": (1, 128),
    "fc2.bias": (1,),
}
"""The released state dict but for ``fc1.weight``, whose width depends on the pooling."""


def make(kind, size=SIZE):
    """A network with fixed weights, in evaluation mode, its norms off their defaults."""
    with seeded(3):
        network = FrameDetector(*size) if kind == "frame" else TemporalDetector(*size, (8, 12, 8), 16, 6)
        for name, buffer in network.named_buffers():
            if buffer.is_floating_point():
                buffer.copy_(torch.rand_like(buffer) + (0.5 if "var" in name else 0.0))
    return network.eval()


def frames(count, seed=0, size=SIZE):
    return np.random.default_rng(seed).integers(-4, 5, (count, *size)).astype(np.int16)


def observe(frame, mode="image"):
    return make_observation(mode, frame, STATE)


def released_state(pool):
    with seeded(0):
        state = {
            name: torch.randint(9, shape) if shape == () else torch.rand(shape)
            for name, shape in RELEASED_SHAPES.items()
        }
        state["fc1.weight"] = torch.randn(128, 4 * (60 // pool) * (80 // pool)) / 50
    return state


@pytest.mark.parametrize("pool", [1, 2])
def test_the_released_state_dict_loads_and_computes_what_it_did(tmp_path, pool):
    state = released_state(pool)
    path = tmp_path / "best_loss.pth"
    torch.save(state, path)
    policy = KeyframeCNN.load(path)
    assert policy.threshold == 0.5
    frame = frames(1, size=(480, 640))
    x = functional.avg_pool2d(torch.from_numpy(frame.astype(np.float32))[:, None], pool)
    for i in (1, 2, 3):
        x = functional.conv2d(x, state[f"conv{i}.weight"], state[f"conv{i}.bias"], padding=1)
        scale = state[f"bn{i}.weight"] / torch.sqrt(state[f"bn{i}.running_var"] + 1e-5)
        x = (x - state[f"bn{i}.running_mean"][:, None, None]) * scale[:, None, None]
        x = functional.leaky_relu(x + state[f"bn{i}.bias"][:, None, None], 0.01)
        x = functional.max_pool2d(x, 2)
    x = functional.leaky_relu(functional.linear(x.reshape(1, -1), state["fc1.weight"], state["fc1.bias"]))
    expected = functional.linear(x, state["fc2.weight"], state["fc2.bias"])
    logits = policy.logits(frame, policy.initial_memory(1))
    np.testing.assert_allclose(logits, expected.numpy(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("bn2.bias"), "missing: bn2.bias"),
        (lambda s: s.update(extra=torch.zeros(1)), "unexpected: extra"),
        (lambda s: s.update({"conv2.weight": torch.zeros(8, 16, 1, 1)}), "of another shape: conv2.weight"),
        (lambda s: s["fc2.bias"].fill_(float("nan")), "not finite: fc2.bias"),
    ],
)
def test_a_released_state_dict_that_does_not_fit_is_refused(tmp_path, change, message):
    state = released_state(2)
    change(state)
    path = tmp_path / "weights.pth"
    torch.save(state, path)
    with pytest.raises(ValueError, match=message) as error:
        load_detector(path)
    assert "weights.pth" in str(error.value)


def test_raw_input_at_released_size_has_the_released_names():
    for pool in (1, 2):
        shapes = {
            name: tuple(t.shape) for name, t in FrameDetector(480, 640, pool, "raw").state_dict().items()
        }
        assert shapes == {**RELEASED_SHAPES, "fc1.weight": (128, 4 * (60 // pool) * (80 // pool))}


@pytest.mark.parametrize("kind", ["frame", "temporal"])
@pytest.mark.parametrize("mode", ["image", "signed", "dict"])
def test_predictions_have_sb3_shapes_in_every_mode_and_agree(kind, mode):
    policy = KeyframeCNN(make(kind))
    pair = frames(2)
    one = observe(pair[0], mode)
    other = observe(pair[1], mode)
    batch = {k: np.stack([one[k], other[k]]) for k in one} if mode == "dict" else np.stack([one, other])
    action, state = policy.predict(one)
    actions, states = policy.predict(batch)
    assert np.shape(action) == () and action in (0, 1)
    assert actions.shape == (2,) and actions.dtype == np.int64
    assert states.shape == (2, policy.network.memory_size) and states.dtype == np.float32
    np.testing.assert_allclose(states[:1], state, atol=1e-6)
    np.testing.assert_allclose(states, policy.predict(np.stack([observe(f) for f in pair]))[1], atol=1e-6)


@pytest.mark.parametrize("kind", ["frame", "temporal"])
def test_step_by_step_equals_the_whole_sequence(kind):
    network = make(kind)
    policy, sequence = KeyframeCNN(network), frames(300)  # longer than one block
    memory = policy.initial_memory(1)
    scores = [probability(policy.logits(frame[None], memory))[0, 0] for frame in sequence]
    np.testing.assert_allclose(policy.score_sequence(sequence), scores, atol=1e-5)
    with torch.inference_mode():
        whole = network(torch.from_numpy(sequence.astype(np.float32))[None])[0, :, 0].numpy()
    np.testing.assert_allclose(probability(whole), scores, atol=1e-5)
    assert policy.score_sequence(sequence[:0]).shape == (0,)


def test_memory_matters_resets_alone_and_is_not_modified():
    policy = KeyframeCNN(make("temporal"))
    left, right = frames(6, seed=1), frames(6, seed=2)
    state, rows = None, []
    for k in range(6):
        before = None if state is None else state.copy()
        batch = np.stack([observe(left[k]), observe(right[k])])
        given, (_, state) = state, policy.predict(batch, state, episode_start=np.array([k == 3, False]))
        if given is not None:
            np.testing.assert_array_equal(given, before)
        rows.append(state)
    expected_left, expected_right = policy.initial_memory(1), policy.initial_memory(1)
    for k in range(6):
        if k == 3:
            expected_left = policy.initial_memory(1)
        policy.logits(left[k : k + 1], expected_left)
        policy.logits(right[k : k + 1], expected_right)
        np.testing.assert_allclose(rows[k], np.concatenate([expected_left, expected_right]), atol=1e-6)
    fresh = policy.initial_memory(1)
    first = policy.logits(left[:1], fresh)
    assert not np.allclose(first, policy.logits(left[:1], fresh), atol=1e-4)  # the same frame, remembered


def test_remembered_answers_are_the_same_and_cannot_be_spoilt():
    policy = KeyframeCNN(make("temporal"))
    frame = frames(1)
    memory = policy.initial_memory(1)
    first = policy.logits(frame, memory)
    expected, after = first.copy(), memory.copy()
    first[:] = 9
    memory[:] = 9
    again = policy.initial_memory(1)
    np.testing.assert_array_equal(policy.logits(frame, again), expected)
    np.testing.assert_array_equal(again, after)


def test_the_threshold_decides():
    network = make("frame")
    score = KeyframeCNN(network).score_sequence(frames(1))[0]
    observation = observe(frames(1)[0])
    assert KeyframeCNN(network, float(score) - 0.01).predict(observation)[0] == 1
    assert KeyframeCNN(network, float(score) + 0.01).predict(observation)[0] == 0


def test_larger_frames_are_averaged_down():
    small = frames(3)
    large = np.repeat(np.repeat(small, 2, axis=1), 2, axis=2)
    np.testing.assert_array_equal(average_down(large, SIZE), small)
    large[:, ::2] += 2
    np.testing.assert_array_equal(average_down(large, SIZE), small + 1)
    policy = KeyframeCNN(make("frame"))
    np.testing.assert_array_equal(
        policy.score_sequence(small), policy.score_sequence(np.repeat(np.repeat(small, 3, 1), 3, 2))
    )


@pytest.mark.parametrize("size", [(16, 20), (32, 41), (64, 40), (0, 0)])
def test_frames_of_other_sizes_are_refused(size):
    with pytest.raises(ValueError, match="expected a whole multiple of 32x40"):
        average_down(np.zeros((1, *size), np.int16), SIZE)


def test_weights_and_card_make_the_policy(tmp_path):
    network = make("temporal")
    path = tmp_path / "detector.safetensors"
    options = {"height": 32, "width": 40, "channels": [8, 12, 8], "hidden": 16, "memory_size": 6}
    card = Card("a test", "keyframe-cnn-temporal", options, metrics={"thresholds": {"default": 0.37}})
    write_weights(path, network.state_dict(), card)
    policy = KeyframeCNN.load(path)
    assert policy.threshold == 0.37
    assert KeyframeCNN.load(path, threshold=0.6).threshold == 0.6
    np.testing.assert_array_equal(
        policy.score_sequence(frames(4)), KeyframeCNN(network).score_sequence(frames(4))
    )
    assert load_detector(path) is load_detector(path)
    write_weights(path, make("temporal").state_dict(), Card("another", "u-net", options))
    with pytest.raises(ValueError, match="found architecture 'u-net'"):
        load_detector(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.safetensors"):
        KeyframeCNN.load(tmp_path / "nothing.safetensors")


def test_threads_come_back():
    before = torch.get_num_threads()
    with pytest.raises(KeyError), limited_threads(before + 1):
        assert torch.get_num_threads() == before + 1
        raise KeyError
    assert torch.get_num_threads() == before


@pytest.mark.parametrize(
    ("build", "argument"),
    [
        (lambda: FrameDetector(8, 8), "height, width:"),
        (lambda: FrameDetector(pool=3), "pool:"),
        (lambda: FrameDetector(inputs="grey"), "inputs:"),
        (lambda: TemporalDetector(15, 40), "height, width:"),
        (lambda: TemporalDetector(channels=()), "channels:"),
        (lambda: KeyframeCNN(make("frame"), threshold=1.5), "threshold:"),
        (lambda: KeyframeCNN(make("frame"), threads=0), "threads:"),
    ],
)
def test_bad_arguments_are_named(build, argument):
    with pytest.raises(ValueError, match=argument):
        build()
