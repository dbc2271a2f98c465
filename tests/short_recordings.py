"""A folder of short recordings as ``scripts/record.py`` leaves it, for tests that learn from recordings."""

import json

from nl_env.config import DrivingConfig, SceneConfig, to_dict
from nl_env.recording import record_sequence


def record(folder, seeds, duration_s, split="train"):
    """Record ``seeds`` on a highway, with depth every 10 ms, and write the manifest; returns ``folder``."""
    config = DrivingConfig(scene=SceneConfig(scenario="highway", duration_s=duration_s))
    (folder / "sequences").mkdir(parents=True)
    files = {seed: f"sequences/{seed}.h5" for seed in seeds}
    for seed, file in files.items():
        record_sequence(folder / file, config, seed, 10_000)
    manifest = {
        "split": split,
        "seeds": list(seeds),
        "config": to_dict(config),
        "sequences": [{"seed": seed, "file": file} for seed, file in files.items()],
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder
