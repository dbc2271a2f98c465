"""What is known of ELiDAR and the network trained on it: the paper's tables, the checkpoint's memory."""

from __future__ import annotations

GAPS_MS = (20, 50, 100, 200, 500)
"""Extrapolation gaps of the paper's accuracy table (50, 20, 10, 5 and 2 Hz)."""

REPEAT = {
    20: (4.976, 1.486, 0.026, 0.697, 0.975, 0.984, 0.987),
    50: (6.904, 2.016, 0.045, 1.341, 0.958, 0.971, 0.978),
    100: (8.382, 2.373, 0.063, 1.884, 0.941, 0.960, 0.970),
    200: (9.820, 2.980, 0.092, 2.603, 0.910, 0.940, 0.954),
    500: (12.211, 3.487, 0.139, 4.521, 0.860, 0.911, 0.933),
}
"""The paper's Repeat row by gap, in the order of ``PAPER_METRICS``."""

NETWORK_RMSE = {20: 3.883, 50: 4.747, 100: 5.542, 200: 6.385, 500: 8.422}
"""RMSE of the paper's network by gap, m."""

PRIOR_SKY = {20: 0.0045, 50: 0.008, 100: 0.011, 200: 0.018, 500: 0.025}
"""Share of valid pixels whose prior is sky, as the Repeat row's log RMSE implies it: a prior of 0 is clipped
at 1e-8 and so costs about 21 in the logarithm."""

MEAN_RATE_HZ = 40.6
"""Mean effective frame rate under the keyframe rule."""

CHECKPOINT_MEMORY = {
    "depth mean, sky = 0 (m)": "about 14",
    "depth standard deviation, sky = 0 (m)": "about 24",
    "depth mean of the top row (m)": "6 to 8",
    "depth mean of the bottom row (m)": "2.1 to 3.1",
    "depth mean of the left column (m)": "about 12.5",
    "depth mean of the right column (m)": "about 12.5",
    "RMS difference of neighbours, 1 px (m)": "7.4",
    "RMS difference of neighbours, 2 px (m)": "9.2",
    "pixels without depth": "at most 0.39",
    "voxel bin standard deviation": "2.1 to 2.6",
    "active pixels per bin": "0.10 to 0.25",
    "RMS count where active": "5 to 8",
    "correlation of adjacent bins": "about -0.3",
}
"""Statistics of ELiDAR recovered from the running moments of the released checkpoint's first batch norms."""
