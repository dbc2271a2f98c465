import numpy as np
import pytest

from nl_env.classification import (
    Detection,
    auroc,
    best_f1_threshold,
    confusion,
    effective_rate,
    even_threshold,
    matching_threshold,
    rate_threshold,
    summarise_detector,
)
from nl_env.evaluation import resample_sequences

SLICES = 50


def detection(seed, scores=None, keyframe=None, weather="ClearNoon"):
    """A sequence of random or given scores; the cause is speed, distance or new in turn."""
    rng = np.random.default_rng(seed)
    keyframe = rng.random(SLICES) < 0.6 if keyframe is None else np.asarray(keyframe, bool)
    if scores is None:
        scores = rng.normal(size=SLICES) + keyframe
    causes = np.zeros((len(keyframe), 3), bool)
    causes[np.arange(len(keyframe)), np.arange(len(keyframe)) % 3] = keyframe
    lidar = np.arange(1, len(keyframe) + 1) % 5 == 0
    return Detection(seed, weather, np.asarray(scores, np.float32), causes, lidar)


def f1(detections, threshold):
    """By the book, over all slices."""
    called = np.concatenate([d.scores > threshold for d in detections])
    truth = np.concatenate([d.keyframe for d in detections])
    hits = np.count_nonzero(called & truth)
    return 2 * hits / (np.count_nonzero(called) + np.count_nonzero(truth))


DETECTIONS = [detection(seed, weather=("ClearNoon", "HardRainNoon")[seed % 2]) for seed in range(6)]
RESAMPLES = resample_sequences(len(DETECTIONS), np.random.default_rng(0))


def test_auroc_counts_ordered_pairs_and_halves_ties():
    assert auroc(np.array([0.9, 0.8, 0.1]), np.array([True, True, False])) == 1
    assert auroc(np.array([0.1, 0.8, 0.9]), np.array([True, False, False])) == 0
    assert auroc(np.array([0.5, 0.5, 0.5]), np.array([True, False, False])) == 0.5
    assert auroc(np.array([3.0, 1.0, 2.0, 1.0]), np.array([True, True, False, False])) == 0.625
    assert np.isnan(auroc(np.array([0.5]), np.array([True])))


def test_a_summary_by_hand():
    keyframe = np.array([1, 1, 1, 0, 0], bool)
    found = detection(0, scores=[0.9, 0.8, 0.2, 0.7, 0.1], keyframe=keyframe)
    summary = summarise_detector([found], 0.5, resample_sequences(1, np.random.default_rng(0)))
    assert confusion(found.scores > 0.5, keyframe) == (2, 1, 1, 1)
    assert summary.f1.mean == summary.f1.low == summary.f1.high == pytest.approx(2 / 3)
    assert summary.precision.mean == summary.recall.mean == pytest.approx(2 / 3)
    assert summary.balanced_accuracy.mean == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert summary.false_positive_rate.mean == 0.5
    assert summary.auroc.mean == pytest.approx(5 / 6)
    assert summary.always_f1.mean == pytest.approx(0.75)
    assert summary.f1_gain.mean == pytest.approx(2 / 3 - 0.75)
    assert summary.keyframes.mean == summary.triggers.mean == 0.6
    # Slice 5 has a LiDAR frame; slices 1, 2 and 4 are triggered: four frames in 0.1 s.
    assert summary.rate.mean == pytest.approx(40)
    assert {cause: e.mean for cause, e in summary.recall_by_cause.items()} == {
        "speed": 1.0,
        "distance": 1.0,
        "new": 0.0,
    }
    assert summary.f1_by_cause["speed"].mean == pytest.approx(2 / 3)  # one hit, one false alarm


def test_a_summary_of_several_sequences_pools_their_slices():
    summary = summarise_detector(DETECTIONS, 0.4, RESAMPLES)
    assert summary.f1.mean == pytest.approx(f1(DETECTIONS, 0.4))
    assert summary.always_f1.mean == pytest.approx(f1(DETECTIONS, -np.inf))
    scores = np.concatenate([d.scores for d in DETECTIONS])
    truth = np.concatenate([d.keyframe for d in DETECTIONS])
    assert summary.auroc.mean == pytest.approx(auroc(scores, truth))
    assert set(summary.f1_by_weather) == {"ClearNoon", "HardRainNoon"}
    assert summary.f1_by_weather["ClearNoon"] == pytest.approx(f1(DETECTIONS[::2], 0.4))


def test_the_interval_of_auroc_is_that_of_resampled_sequences():
    drawn = []
    for chosen in RESAMPLES[:200]:
        picked = [DETECTIONS[i] for i in chosen]
        scores = np.concatenate([d.scores for d in picked])
        drawn.append(auroc(scores, np.concatenate([d.keyframe for d in picked])))
    summary = summarise_detector(DETECTIONS, 0.4, RESAMPLES[:200])
    assert (summary.auroc.low, summary.auroc.high) == pytest.approx(tuple(np.quantile(drawn, [0.025, 0.975])))


def test_always_answering_keyframe_gains_nothing():
    summary = summarise_detector(DETECTIONS, -np.inf, RESAMPLES)
    gain = summary.f1_gain
    assert (gain.mean, gain.low, gain.high) == pytest.approx((0, 0, 0), abs=1e-12)
    assert summary.balanced_accuracy.mean == 0.5
    assert summary.false_positive_rate.mean == summary.recall.mean == 1
    assert summary.rate.mean == 50


def test_the_best_f1_threshold_beats_every_other():
    best = f1(DETECTIONS, best_f1_threshold(DETECTIONS))
    for score in np.concatenate([d.scores for d in DETECTIONS]):
        assert f1(DETECTIONS, score) <= best + 1e-12


def test_the_best_f1_threshold_does_not_split_equal_scores():
    found = detection(0, scores=[0.7, 0.7, 0.7, 0.2], keyframe=[True, False, True, False])
    threshold = best_f1_threshold([found])
    assert 0.2 <= threshold < 0.7
    assert f1([found], threshold) == pytest.approx(0.8)


def test_the_matching_threshold_calls_as_many_keyframes_as_there_are():
    summary = summarise_detector(DETECTIONS, matching_threshold(DETECTIONS), RESAMPLES)
    assert summary.triggers.mean == summary.keyframes.mean
    assert summary.precision.mean == summary.recall.mean == pytest.approx(summary.f1.mean)
    tied = detection(0, scores=[0.7, 0.5, 0.5, 0.2], keyframe=[True, False, True, False])
    assert 0.5 <= matching_threshold([tied]) < 0.7  # one trigger rather than three


def test_the_even_threshold_errs_alike_on_keyframes_and_others():
    def uneven(threshold):
        summary = summarise_detector(DETECTIONS, threshold, RESAMPLES[:2])
        return abs(summary.recall.mean - (1 - summary.false_positive_rate.mean))

    scores = np.concatenate([d.scores for d in DETECTIONS])
    found = uneven(even_threshold(DETECTIONS))
    assert found < 0.02
    assert all(found <= uneven(score) + 1e-12 for score in scores)
    tied = detection(0, scores=[0.7, 0.5, 0.5, 0.2], keyframe=[True, True, False, False])
    assert 0.5 <= even_threshold([tied]) < 0.7


def test_the_even_threshold_does_not_depend_on_the_share_of_keyframes():
    scores, keyframe = [0.9, 0.7, 0.4, 0.6, 0.3, 0.1], [True] * 3 + [False] * 3
    rare = detection(0, scores=scores + [0.6, 0.3, 0.1] * 5, keyframe=keyframe + [False] * 15)
    common = detection(0, scores=scores + [0.9, 0.7, 0.4] * 5, keyframe=keyframe + [True] * 15)
    assert even_threshold([rare]) == even_threshold([common])
    assert best_f1_threshold([rare]) > best_f1_threshold([common])


@pytest.mark.parametrize("rate", [15, 30.0, 41, 49.9, 50])
def test_the_rate_threshold_spends_the_rate_and_no_more(rate):
    threshold = rate_threshold(DETECTIONS, rate)
    reached = np.mean([effective_rate(d, threshold) for d in DETECTIONS])
    one_more = 1 / (SLICES * 0.02) / len(DETECTIONS)
    assert rate - one_more < reached <= rate


def test_the_rate_threshold_with_no_room_for_a_trigger():
    threshold = rate_threshold(DETECTIONS, 10)
    assert np.mean([effective_rate(d, threshold) for d in DETECTIONS]) == 10
    with pytest.raises(ValueError, match="rate_hz: found 9"):
        rate_threshold(DETECTIONS, 9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: detection(0, scores=[0.1, np.nan], keyframe=[True, False]), "not finite"),
        (lambda: detection(0, scores=[0.1], keyframe=[True, False]), "found scores"),
        (lambda: best_f1_threshold([detection(0, keyframe=[False] * SLICES)]), "no keyframe"),
        (lambda: even_threshold([detection(0, keyframe=[False] * SLICES)]), "no keyframe"),
        (lambda: even_threshold([detection(0, keyframe=[True] * SLICES)]), "keyframes alone"),
        (lambda: summarise_detector([], 0.5, RESAMPLES), "0 sequences"),
        (lambda: summarise_detector(DETECTIONS[:2], 0.5, RESAMPLES), "2 sequences"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
