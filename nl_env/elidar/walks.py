"""Chains of pairs through a sequence: the truth of one row is the prior of the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nl_env.elidar.metadata import SequencePairs


def find_walks(pairs: SequencePairs, ticks: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Sort every row of a sequence into a chain; each row belongs to exactly one.

    The released rows are three chains from the first depth frame to the last, and come out as that. Where
    chains meet, which goes on with which row does not matter: rows that start there start alike.

    Args:
        pairs: the rows.
        ticks: ``(frames,)`` tick of each depth frame.

    Returns:
        Row indices of each chain in order of time; the chain that starts first comes first.
    """
    ends: list[int] = []
    walks: list[list[int]] = []
    for row in np.argsort(ticks[pairs.prior], kind="stable").tolist():
        prior, truth = int(pairs.prior[row]), int(pairs.truth[row])
        if prior in ends:
            walk = ends.index(prior)
        else:
            walk = len(walks)
            walks.append([])
            ends.append(prior)
        walks[walk].append(row)
        ends[walk] = truth
    return [np.array(walk, np.int64) for walk in walks]
