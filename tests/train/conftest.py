import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SMALL = ["data.width=24", "data.height=24", "system.report.video_frames=0", "trainer.accelerator=cpu"]


@pytest.fixture
def launch(tmp_path, monkeypatch):
    """Run the launcher in this process on a small statue; returns the trial's folder."""
    monkeypatch.syspath_prepend(str(ROOT))
    import launch as launcher

    def run(config: str, *overrides: str, mode: str = "--train", name: str = "run", status: int = 0) -> Path:
        """A run that does not resume has a folder of its own: name, or where there is one of it, name-2, name-3, ..."""
        taken = sum(f.name == name or f.name.startswith(f"{name}-") for f in tmp_path.iterdir())
        if taken and not any(o.startswith("resume=") for o in overrides):
            name = f"{name}-{taken + 1}"
        arguments = ["--config", str(ROOT / "configs" / config), mode, "data.source=demo:statue", *SMALL]
        arguments += [f"exp_root_dir={tmp_path}", f"name={name}", "tag=trial", "use_timestamp=false", *overrides]
        monkeypatch.setattr(sys, "argv", ["launch.py", *arguments])
        assert launcher.main(arguments) == status
        return tmp_path / name / "trial"

    return run
