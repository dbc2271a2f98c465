"""The figures of the paper's tables, by the labels of its source; metrics ordered as ``PAPER_METRICS``."""

from __future__ import annotations

from nl_env.realism.published import GAPS_MS, MEAN_RATE_HZ, NETWORK_RMSE, REPEAT

__all__ = [
    "ABLATION",
    "ADAPTIVE",
    "ADAPTIVE_NETWORK",
    "ADAPTIVE_REPEAT",
    "CAUSE_F1",
    "END_TO_END",
    "GAPS_MS",
    "KEYFRAMES",
    "MEAN_RATE_HZ",
    "NETWORK",
    "RATE_RANGE_HZ",
    "REPEAT",
    "WEATHER_F1",
]

KEYFRAMES = {"train": (0.888, 0.893, 0.884), "test": (0.798, 0.825, 0.773)}
"""Table ``keyframe_TrainTestAcc``: F1, precision, recall by split."""

WEATHER_F1 = (0.754, 0.828)
"""Lowest and highest F1 over weather conditions (figure ``weather_key``)."""

CAUSE_F1 = {"speed": 0.86, "distance": 0.89, "new": 0.72}
"""F1 by what makes a slice a keyframe (figure ``motion_key``)."""

NETWORK = {
    gap: (NETWORK_RMSE[gap], *rest)
    for gap, rest in {
        20: (0.185, 0.036, 0.325, 0.974, 0.989, 0.994),
        50: (0.237, 0.046, 0.500, 0.963, 0.984, 0.991),
        100: (0.292, 0.055, 0.689, 0.953, 0.979, 0.988),
        200: (0.394, 0.074, 1.010, 0.929, 0.967, 0.981),
        500: (0.528, 0.109, 2.075, 0.885, 0.944, 0.967),
    }.items()
}
"""Table ``acc_fps``, rows "Ours", by gap in ms. The rows of Repeat are ``REPEAT``."""

ADAPTIVE = "adaptive"
"""The gap of the rows "Adap.": frames sampled at varying rates."""

ADAPTIVE_REPEAT = (8.414, 2.455, 0.072, 2.187, 0.929, 0.953, 0.964)
ADAPTIVE_NETWORK = (5.769, 0.325, 0.063, 0.910, 0.941, 0.972, 0.984)
"""Table ``acc_fps``, rows "Adap."."""

ABLATION = {
    "without events": (7.799, 0.364, 0.103, 1.693, 0.911, 0.952, 0.967),
    "event frame": (6.161, 0.332, 0.071, 1.082, 0.933, 0.968, 0.981),
    "data concat": (5.936, 0.315, 0.073, 0.954, 0.936, 0.970, 0.983),
    "without skip": (5.935, 0.392, 0.079, 0.985, 0.931, 0.969, 0.983),
    "as published": ADAPTIVE_NETWORK,
}
"""Table ``ablation``, measured by the paper on its adaptive setting."""

END_TO_END = {
    "repeat": (6.226, 1.912, 0.045, 1.210, 0.956, 0.971, 0.956),
    "linear": (8.248, 2.758, 0.075, 1.992, 0.926, 0.952, 0.963),
    "exponential": (25.131, 3.589, 0.454, 10.683, 0.255, 0.520, 0.622),
    "network": (4.416, 0.245, 0.047, 0.457, 0.962, 0.984, 0.991),
}
"""Table ``system_eval``: errors of the frames made at detected keyframes."""

RATE_RANGE_HZ = (27.81, 47.30)
"""Lowest and highest effective frame rate of a sequence; their mean is ``MEAN_RATE_HZ``."""
