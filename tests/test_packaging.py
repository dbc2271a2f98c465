"""The wheel ships ``nl_env`` whole and nothing else."""

import email
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import nl_env

ROOT = Path(__file__).parents[1]
IGNORED = shutil.ignore_patterns(
    ".*", "__pycache__", "*.nb[ic]", "*.egg-info", "build", "dist", "runs", "logs"
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel built from a copy of the checkout, so that nothing is written into the checkout."""
    copy = tmp_path_factory.mktemp("wheel") / "checkout"
    shutil.copytree(ROOT, copy, ignore=IGNORED)
    build = "import setuptools.build_meta as backend; backend.build_wheel('dist')"
    subprocess.run([sys.executable, "-c", build], cwd=copy, check=True, capture_output=True)
    (path,) = (copy / "dist").glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield archive


def metadata(wheel):
    (name,) = (n for n in wheel.namelist() if n.endswith(".dist-info/METADATA"))
    return email.message_from_bytes(wheel.read(name))


def test_it_holds_nl_env_alone(wheel):
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert tops == {"nl_env", f"nl_env-{nl_env.__version__}.dist-info"}


def test_it_holds_every_file_of_nl_env(wheel):
    package = ROOT / "nl_env"
    files = {
        path.relative_to(ROOT).as_posix()
        for path in package.rglob("*")
        if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc")
    }
    assert {"nl_env/py.typed", "nl_env/report_page.html"} <= files
    assert {name for name in wheel.namelist() if name.startswith("nl_env/")} == files


def test_its_metadata(wheel):
    data = metadata(wheel)
    assert data["Name"] == "nl-env"
    assert data["Version"] == nl_env.__version__
    assert data["License-Expression"] == "MIT"
    required = [line for line in data.get_all("Requires-Dist") if "extra ==" not in line]
    assert not [line for line in required if line.startswith(("stable", "matplotlib", "openvino"))]


def test_constraints_pin_every_direct_dependency(wheel):
    lines = [line for line in metadata(wheel).get_all("Requires-Dist") if not line.startswith("nl-env")]
    names = {canonical(re.match(r"[\w.-]+", line).group()) for line in lines}
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {canonical(pin.split("==")[0]) for pin in pins if "==" in pin}
    assert {"numpy", "torch", "pytest"} <= names <= pinned


def canonical(name):
    return name.lower().replace("_", "-")
