import io
import json
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from nl_env.weight_files import (
    Card,
    load_network,
    load_strictly,
    read_card,
    read_tensors,
    write_card,
    write_weights,
)

CARD = Card("a line", "line", options={"inputs": 3}, metrics={"error": 0.25})


class Line(nn.Module):
    def __init__(self, inputs):
        super().__init__()
        self.layer = nn.Linear(inputs, 2)
        self.norm = nn.BatchNorm1d(2)

    def forward(self, x):
        return self.norm(self.layer(x))


ARCHITECTURES = {"line": Line}


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "line.safetensors"
    write_weights(path, Line(3).state_dict(), CARD)
    return path


def test_round_trip(written):
    network, card = load_network(written, ARCHITECTURES)
    assert not network.training
    assert replace(card, sha256="") == CARD and len(card.sha256) == 64
    tensors = read_tensors(written)
    assert all(torch.equal(tensor, tensors[name]) for name, tensor in network.state_dict().items())


def test_same_tensors_same_bytes_whatever_their_order_in_memory(written, tmp_path):
    tensors = read_tensors(written)
    reordered = {name: tensors[name] for name in reversed(tensors)}
    reordered["layer.weight"] = reordered["layer.weight"].T.contiguous().T
    other = tmp_path / "other.safetensors"
    write_weights(other, reordered, CARD)
    assert other.read_bytes() == written.read_bytes()


def test_a_card_can_be_extended(written):
    card = read_card(written)
    write_card(written, replace(card, metrics={**card.metrics, "threshold": 0.4}))
    assert load_network(written, ARCHITECTURES)[1].metrics == {"error": 0.25, "threshold": 0.4}


def test_a_card_of_other_weights_is_refused(written, tmp_path):
    other = tmp_path / "other.safetensors"
    write_weights(other, Line(3).state_dict(), CARD)
    other.replace(written)
    with pytest.raises(ValueError, match=r"line\.json' was written for other weights"):
        load_network(written, ARCHITECTURES)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"architecture": "curve"}, "found architecture 'curve' .*expected one of line"),
        ({"options": {"outputs": 3}}, "found options .* that 'line' does not take"),
        ({"options": {"inputs": 4}}, r"does not fit Line, of another shape: layer\.weight \(2, 3\)"),
        ({"options": [3]}, r"found options \[3\] in .*line\.json', expected a dict"),
        ({"colour": "red"}, "expected the fields"),
    ],
)
def test_wrong_cards_are_explained(written, change, message):
    path = written.with_suffix(".json")
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ValueError, match=message):
        load_network(written, ARCHITECTURES)


def test_a_card_that_is_no_json_or_missing(written):
    card = written.with_suffix(".json")
    card.write_text("{")
    with pytest.raises(ValueError, match=r"found no JSON in .*line\.json"):
        read_card(written)
    card.unlink()
    assert read_card(written) is None
    with pytest.raises(FileNotFoundError, match=r"found no 'line\.json' beside"):
        load_network(written, ARCHITECTURES)
    with pytest.raises(FileNotFoundError, match="found no file"):
        read_tensors(written.with_name("nowhere.safetensors"))


def test_wrong_tensors_are_explained(written):
    tensors = read_tensors(written)
    del tensors["layer.bias"]
    tensors["extra"] = torch.zeros(1)
    tensors["layer.weight"] = torch.full((2, 3), torch.nan)
    with pytest.raises(
        ValueError, match=r"missing: layer\.bias; unexpected: extra; not finite: layer\.weight"
    ):
        load_strictly(Line(3), tensors, written)


@pytest.mark.parametrize("keep", [0, 4, 100, -1])
def test_truncated_safetensors(written, keep):
    written.write_bytes(written.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"found no safetensors data in .*line\.safetensors"):
        read_tensors(written)


class Trap:
    """Unpickling it leaves a file behind."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return (Path.touch, (Path(self.marker),))


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("form", ["zip", "legacy", "plain"])
def test_a_planted_payload_never_runs(tmp_path, suffix, form):
    path, marker = tmp_path / f"trap{suffix}", tmp_path / "ran"
    content = {"weight": torch.zeros(2), "payload": Trap(str(marker))}
    if form == "plain":
        path.write_bytes(pickle.dumps({"payload": Trap(str(marker))}, protocol=2))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=form == "zip")
    with pytest.raises(ValueError, match=rf"trap\{suffix}"):
        read_tensors(path)
    assert not marker.exists()
    data = path.read_bytes()
    torch.load(io.BytesIO(data), weights_only=False) if form != "plain" else pickle.loads(data)
    assert marker.exists()  # the trap was armed


def test_damaged_state_dicts_are_explained(tmp_path):
    whole, path = tmp_path / "whole.pth", tmp_path / "damaged.pth"
    torch.save(Line(3).state_dict(), whole)
    data = whole.read_bytes()
    for damaged in (b"", b"not weights", data[:200], data[:-300]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"found no plain state dict in .*damaged\.pth"):
            read_tensors(path)
    for other in ([1, 2], {"weight": 3}, {1: torch.zeros(1)}):
        torch.save(other, path)
        with pytest.raises(ValueError, match="expected a state dict"):
            read_tensors(path)


def test_only_safetensors_are_written(tmp_path):
    with pytest.raises(ValueError, match=r"found file name 'line\.pth'"):
        write_weights(tmp_path / "line.pth", Line(3).state_dict(), CARD)
    assert not list(tmp_path.iterdir())
