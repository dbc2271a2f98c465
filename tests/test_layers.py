"""Holds the architecture: imports point downward only, and heavy packages stay where they belong."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

LAYERS = (
    ("types",),
    ("command_line", "config", "lanes", "runs"),
    ("scene", "sensors", "representations", "keyframes", "statistics", "costs", "steps"),
    ("simulator",),
    ("recording", "weight_files"),
    ("elidar", "training"),
    ("streams", "recording_stream", "elidar_stream", "importing"),
    ("depth",),
    ("history", "ledger", "batched_ledger", "observations", "rewards", "colours"),
    ("traces", "trace_source", "held_depth"),
    ("trace_files",),
    ("trace_stream",),
    ("trace_stack", "viewer"),
    ("env",),
    ("driving", "indoor_env", "replay"),
    ("batched_replay",),
    ("wrappers",),
    ("curves", "evaluation", "realism"),
    ("classification", "frontier"),
    ("comparison",),
    ("frame_rates",),
    ("tables", "plots"),
    ("page", "reproduction", "inspection"),
    ("report",),
)
"""Parts of ``nl_env``, bottom first; a part imports from lower layers and from itself."""
RANK = {part: rank for rank, parts in enumerate(LAYERS) for part in parts}

ONLY_IMPORTER = {"highway_env": "nl_env.scene.traffic", "pygame": "nl_env.viewer"}
"""Packages and the one part that may import them."""


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules(package):
    return {module_name(path): path for path in sorted((ROOT / package).rglob("*.py"))}


MODULES = {**modules("nl_env"), **modules("agents")}


def imported(path):
    """Every module a file imports, also inside functions; ``from a import b`` may mean module ``a.b``."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                yield submodule if submodule in MODULES else node.module


def part_of(module):
    return module.split(".")[1]


def violations(imports):
    """Imports of ``{module: modules imported}`` that point upward or sideways."""
    return [
        f"{module} imports {target}"
        for module, targets in imports.items()
        if module.startswith("nl_env.")
        for target in targets
        if target.startswith("nl_env.")
        and part_of(target) != part_of(module)
        and RANK[part_of(target)] >= RANK[part_of(module)]
    ]


IMPORTS = {module: set(imported(path)) for module, path in MODULES.items()}


def test_every_module_has_a_layer():
    assert {part_of(module) for module in MODULES if module.startswith("nl_env.")} <= set(RANK) | {"weights"}


def test_imports_point_downward():
    assert violations(IMPORTS) == []


@pytest.mark.parametrize(
    ("module", "target"),
    [
        ("nl_env.types", "nl_env.config"),
        ("nl_env.depth.warp", "nl_env.env"),
        ("nl_env.scene.render", "nl_env.sensors.lidar"),
    ],
)
def test_a_wrong_import_would_be_found(module, target):
    assert violations({module: {target}}) == [f"{module} imports {target}"]


def test_nl_env_never_imports_agents_or_scripts():
    for module, targets in IMPORTS.items():
        if module.startswith("nl_env"):
            assert not {t for t in targets if t.split(".")[0] in ("agents", "scripts", "tests")}, module


def test_no_circular_imports():
    graph = {module: targets & set(MODULES) - {module} for module, targets in IMPORTS.items()}
    assert set(TopologicalSorter(graph).static_order()) == set(MODULES)  # a cycle raises CycleError


@pytest.mark.parametrize(("package", "importer"), ONLY_IMPORTER.items())
def test_packages_with_one_importer(package, importer):
    for module, targets in IMPORTS.items():
        if package in {target.split(".")[0] for target in targets}:
            assert module == importer or module.startswith(f"{importer}."), module


def test_importing_and_registering_is_light():
    """``import nl_env`` loads neither torch nor the simulator; the driving environment loads no torch."""
    code = (
        "import sys, nl_env, gymnasium;"
        "print([m for m in ('torch', 'numba', 'highway_env', 'nl_env.env') if m in sys.modules]);"
        "import nl_env.driving;"
        "print([m for m in ('torch',) if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert result.stdout.split() == ["[]", "[]"]


def test_registration_is_idempotent():
    import gymnasium

    import nl_env

    spec = gymnasium.spec("nl_env/Driving-v0")
    nl_env.register_envs()
    assert gymnasium.spec("nl_env/Driving-v0") is spec
