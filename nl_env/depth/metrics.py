"""How far a depth frame is from the true one: the paper's metrics and the full-image metrics.

The paper's metrics look only at pixels whose truth has a return, so whatever is drawn into the sky
is free. The full-image metrics count every pixel and read "no return" as the sensor range on both
sides. Both sets are computed per image and averaged over images by the caller.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.error_sums import both_sums, full_sums, paper_sums

ErrorFunction = Callable[[NDArray[np.float32], NDArray[np.float32], float, float], float]
"""``(pred, truth, max_depth, min_depth) -> error``, smaller is better."""


class PaperMetrics(NamedTuple):
    """The paper's evaluation metrics of one image, over pixels with ``0 < truth < max_depth``.

    Every field is NaN when no pixel is valid (an image of nothing but sky); averages over a
    sequence skip such images.

    Attributes:
        rmse: root mean squared error, m.
        log_rmse: root mean squared difference of natural logarithms.
        abs_rel: mean of ``|pred - truth| / truth``.
        sq_rel: mean of ``(pred - truth)^2 / truth``, m.
        delta_1, delta_2, delta_3: share of pixels with ``max(pred/truth, truth/pred)`` below
            1.25, 1.25^2, 1.25^3.
    """

    rmse: float
    log_rmse: float
    abs_rel: float
    sq_rel: float
    delta_1: float
    delta_2: float
    delta_3: float


class FullMetrics(NamedTuple):
    """Metrics over every pixel; depths are clipped to ``[min_depth, max_depth]``, no return is ``max_depth``.

    Attributes:
        log_mae: mean of ``|ln pred - ln truth|``.
        imae: mean absolute difference of inverse depth, 1/km.
        irmse: root mean squared difference of inverse depth, 1/km.
        bad_25, bad_10: share of pixels whose depths differ by a factor above 1.25, 1.10.
        false_return: share of all pixels with a predicted return and no true one.
        missed_return: share of all pixels with a true return and no predicted one.
    """

    log_mae: float
    imae: float
    irmse: float
    bad_25: float
    bad_10: float
    false_return: float
    missed_return: float


PAPER_METRICS: tuple[str, ...] = PaperMetrics._fields
FULL_METRICS: tuple[str, ...] = FullMetrics._fields
METRIC_NAMES: tuple[str, ...] = PAPER_METRICS + FULL_METRICS
LOWER_IS_BETTER: dict[str, bool] = {name: not name.startswith("delta") for name in METRIC_NAMES}


def paper_metrics(pred: NDArray[np.float32], truth: NDArray[np.float32], max_depth: float) -> PaperMetrics:
    """The paper's metrics of one image (its section "Evaluation Metrics" and the released evaluation).

    Args:
        pred: ``(H, W)`` float32 m, clipped below at 1e-8; a "no return" (0) where the truth has
            depth therefore dominates ``log_rmse``, as in the published Repeat rows.
        truth: ``(H, W)`` float32 m; valid where ``0 < truth < max_depth``.
        max_depth: sensor range, m.

    Returns:
        The seven metrics; all NaN when no pixel is valid.

    Raises:
        ValueError: shapes differ or are not 2-d, or a valid pixel is predicted NaN or infinite.
    """
    pred, truth = _checked(pred, truth)
    return _paper(paper_sums(pred.ravel(), truth.ravel(), np.float32(max_depth)))


def full_metrics(
    pred: NDArray[np.float32], truth: NDArray[np.float32], max_depth: float, min_depth: float = 1.0
) -> FullMetrics:
    """The full-image metrics of one image: every pixel counts.

    Args:
        pred, truth: ``(H, W)`` float32 m; 0 and anything from ``max_depth`` on mean "no return".
            A network without a return head goes through :func:`returns_from_depth` first.
        max_depth: sensor range, m.
        min_depth: depths below are read as this one, m (1 outdoors, 0.1 indoors).

    Raises:
        ValueError: shapes differ or are not 2-d, limits are not ``0 < min_depth < max_depth``, or
            a depth is negative, NaN or infinite.
    """
    _check_limits(min_depth, max_depth)
    pred, truth = _checked(pred, truth)
    sums = full_sums(pred.ravel(), truth.ravel(), np.float32(max_depth), np.float32(min_depth))
    return _full(sums, pred.size)


def all_metrics(
    pred: NDArray[np.float32],
    truth: NDArray[np.float32],
    max_depth: float,
    min_depth: float = 1.0,
    pred_if_return: NDArray[np.float32] | None = None,
) -> dict[str, float]:
    """Both sets by name, in the order of :data:`METRIC_NAMES`; one pass over the images where it can be.

    Args:
        pred, truth, max_depth, min_depth: as :func:`full_metrics`.
        pred_if_return: ``(H, W)`` float32 m, depth where a return would be, for the paper's metrics, which
            ignore missing returns; None where it is ``pred``.

    Raises:
        ValueError: as :func:`paper_metrics` and :func:`full_metrics`.
    """
    if pred_if_return is None or pred_if_return is pred:
        _check_limits(min_depth, max_depth)
        pred, truth = _checked(pred, truth)
        paper_parts, full_parts = both_sums(
            pred.ravel(), truth.ravel(), np.float32(max_depth), np.float32(min_depth)
        )
        paper, full = _paper(paper_parts), _full(full_parts, pred.size)
    else:
        paper = paper_metrics(pred_if_return, truth, max_depth)
        full = full_metrics(pred, truth, max_depth, min_depth)
    return dict(zip(METRIC_NAMES, (*paper, *full), strict=True))


def returns_from_depth(depth: NDArray[np.float32], min_return: float = 1.0) -> NDArray[np.float32]:
    """Read "no return" out of a network without a return head: depths below ``min_return`` m become 0."""
    return np.where(depth < min_return, np.float32(0), depth)


def error(name: str) -> ErrorFunction:
    """The error behind a metric's name, as a function of ``(pred, truth, max_depth, min_depth)``.

    Smaller is always better: ``delta_n`` counts the pixels *outside* the factor, ``1 - delta_n``.
    The paper's metrics are NaN for an image without a valid pixel.

    Raises:
        ValueError: unknown name; the message lists the valid ones.
    """
    if name in FULL_METRICS:
        column = FULL_METRICS.index(name)
        return lambda pred, truth, *limits: full_metrics(pred, truth, *limits)[column]
    if name in PAPER_METRICS:
        column = PAPER_METRICS.index(name)
        if LOWER_IS_BETTER[name]:
            return lambda pred, truth, max_depth, min_depth: paper_metrics(pred, truth, max_depth)[column]
        return lambda pred, truth, max_depth, min_depth: 1.0 - paper_metrics(pred, truth, max_depth)[column]
    raise ValueError(f"error: found {name!r}, expected one of {', '.join(METRIC_NAMES)}")


def _paper(sums: tuple[Any, ...]) -> PaperMetrics:
    """The metrics of :func:`paper_sums`."""
    valid, squared, squared_log, relative, squared_relative, inside_1, inside_2, inside_3 = sums
    if valid == 0:
        return PaperMetrics(*(math.nan,) * 7)
    if not math.isfinite(squared):
        raise ValueError("pred: found NaN or infinity at a valid pixel, expected finite depths in metres")
    return PaperMetrics(
        math.sqrt(squared / valid),
        math.sqrt(squared_log / valid),
        relative / valid,
        squared_relative / valid,
        inside_1 / valid,
        inside_2 / valid,
        inside_3 / valid,
    )


def _full(sums: tuple[Any, ...], pixels: int) -> FullMetrics:
    """The metrics of :func:`full_sums` of an image with ``pixels``."""
    broken, log, inverse, squared_inverse, bad_25, bad_10, false_return, missed_return = sums
    if broken:
        raise ValueError("pred, truth: found negative or non-finite depths, expected metres, 0 = no return")
    return FullMetrics(
        log / pixels,
        1000.0 * inverse / pixels,
        1000.0 * math.sqrt(squared_inverse / pixels),
        bad_25 / pixels,
        bad_10 / pixels,
        false_return / pixels,
        missed_return / pixels,
    )


def _check_limits(min_depth: float, max_depth: float) -> None:
    if not 0 < min_depth < max_depth:
        raise ValueError(f"min_depth: found {min_depth!r}, expected a value in (0, max_depth={max_depth!r})")


def _checked(pred: Any, truth: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    pred = np.ascontiguousarray(pred, np.float32)
    truth = np.ascontiguousarray(truth, np.float32)
    if truth.ndim != 2:
        raise ValueError(f"truth: found shape {truth.shape}, expected (H, W)")
    if pred.shape != truth.shape:
        raise ValueError(f"pred: found shape {pred.shape}, expected the shape of truth, {truth.shape}")
    return pred, truth
