"""What a stored trace was computed from: recording, extrapolator and LiDAR, each by its content."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from nl_env.config import LidarConfig, choice
from nl_env.depth.exported import DESCRIPTION
from nl_env.depth.extrapolators import NAMES, NETWORKS, WEIGHTS
from nl_env.weight_files import read_card


@dataclass(frozen=True)
class TraceSource:
    """What a trace was computed from. Traces of equal sources are equal.

    Attributes:
        recording: SHA-256 of the recording's file.
        extrapolator: its name, or ``"network"`` for weights.
        weights: :func:`weights_digest` of a network, empty for the others.
        odometry: whether it was given the true poses.
        lidar_hz, beams: the LiDAR, see :class:`nl_env.config.LidarConfig`.
        min_depth: depths below are read as this one by the full-image metrics, m.
    """

    recording: str
    extrapolator: str
    weights: str
    odometry: bool
    lidar_hz: int
    beams: int
    min_depth: float

    @classmethod
    def of(
        cls, recording: str, extrapolator: ExtrapolatorIdentity, lidar: LidarConfig, min_depth: float = 1.0
    ) -> TraceSource:
        """The source with this digest of a recording, this extrapolator and LiDAR."""
        return cls(
            recording, **asdict(extrapolator), lidar_hz=lidar.rate_hz, beams=lidar.beams, min_depth=min_depth
        )

    def check(self, found: TraceSource, path: Path) -> None:
        """Raise ``ValueError`` naming ``path`` and every difference unless ``found`` equals this source."""
        others = asdict(found)
        differences = [
            f"{name} is {others[name]!r}, expected {value!r}"
            for name, value in asdict(self).items()
            if others[name] != value
        ]
        if differences:
            raise ValueError(
                f"{path}: found a trace of something else: {'; '.join(differences)}; precompute it again"
            )


@dataclass(frozen=True)
class ExtrapolatorIdentity:
    """Which extrapolator made a trace; the fields are :class:`TraceSource`'s."""

    extrapolator: str
    weights: str
    odometry: bool


def identify_extrapolator(spec: str | os.PathLike[str], odometry: bool = False) -> ExtrapolatorIdentity:
    """Identity of the extrapolator that :func:`nl_env.depth.extrapolators.make_extrapolator` makes.

    Args:
        spec: a name, or a path to weights or to an exported folder.
        odometry: whether it is given the true poses.

    Raises:
        ValueError: unknown name.
        FileNotFoundError: no such weights.
    """
    name = os.fspath(spec)
    if name in NETWORKS:
        return ExtrapolatorIdentity("network", weights_digest(WEIGHTS / f"{name}.safetensors"), odometry)
    path = Path(name)
    if path.exists() or path.suffix or os.sep in name:
        return ExtrapolatorIdentity("network", weights_digest(path), odometry)
    choice("extrapolator", name, NAMES)
    return ExtrapolatorIdentity(name, "", odometry)


def weights_digest(path: Path) -> str:
    """SHA-256 of weights and of how their card builds the network; of the description of an export.

    What else a card says, such as metrics, may change.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the card beside it belongs to other weights.
    """
    if path.is_dir():
        return file_digest(path / DESCRIPTION)
    digest, card = file_digest(path), read_card(path)
    if card is None:
        return digest
    built = json.dumps([digest, card.architecture, card.options], sort_keys=True)
    return hashlib.sha256(built.encode("utf-8")).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, hex."""
    sha = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            sha.update(block)
    return sha.hexdigest()
