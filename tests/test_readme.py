"""The examples of the documentation run as they are, and its links lead somewhere."""

import re
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/environment.md")


def example(page, heading):
    """The one Python block under ``heading``."""
    text = (ROOT / page).read_text(encoding="utf-8")
    section = re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE).group(1)
    (block,) = re.findall(r"^```python\n(.*?)^```", section, re.DOTALL | re.MULTILINE)
    return compile(block, f"{page}: {heading}", "exec")


def run(page, heading, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "example"}
    exec(example(page, heading), names)
    return names


def test_drive(monkeypatch, tmp_path, capsys):
    names = run("README.md", "Drive", monkeypatch, tmp_path)
    rate, error = map(float, re.findall(r"[\d.]+", capsys.readouterr().out))
    assert 9 < rate <= 50
    assert error >= 0
    assert names["env"].observation_space.contains(names["observation"])
    assert Image.open(tmp_path / "driving.png").size == Image.open(ROOT / "docs/images/driving.png").size


def test_write_your_own_trigger_policy(monkeypatch, tmp_path, capsys):
    run("README.md", "Write your own trigger policy", monkeypatch, tmp_path)
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [line[0] for line in lines] == ["Never", "LowerHalf", "Always"]
    rates = [float(line[1]) for line in lines]
    assert rates[0] == 10 <= rates[1] <= rates[2] == 50


def test_write_your_own_extrapolator(monkeypatch, tmp_path):
    env = run("docs/environment.md", "Extrapolators", monkeypatch, tmp_path)["env"]
    env.reset(seed=0)
    info = env.step(1)[4]
    assert info["triggered"]
    assert (env.unwrapped.depth == env.unwrapped.prior_depth).all()


@pytest.mark.parametrize("page", PAGES)
def test_links_to_files_lead_somewhere(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    targets = [t for t in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in t]
    missing = [t for t in targets if not (ROOT / page).parent.joinpath(t).is_file()]
    assert not missing


def test_commands_of_the_readme_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    commands = re.findall(r"^make (\w+)", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert commands == ["compare", "test"]
    for target in commands:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)
