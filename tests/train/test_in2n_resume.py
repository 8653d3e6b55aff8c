"""A resumed dataset update goes on from the pictures that it had: edits are in the checkpoint."""

from __future__ import annotations

from pathlib import Path

import torch

import launch

CONFIG = Path(launch.__file__).parent / "configs/closed-form.yaml"
OPTIONS = [
    "name=t", "tag=t", "use_timestamp=false", "trainer.accelerator=cpu", "system.guidance.rule=in2n", "data.width=32",
    "system.guidance.per_editing_step=0", "system.guidance.diffusion_steps=2", "data.height=32", "data.max_view_num=2",
    "system.report.every=0", "system.report.video_frames=0", "system.report.pictures=0", "system.report.views=1",
    "system.learning_rates.decay=1", "system.learning_rates.means_decay=1", "checkpoint.every_n_train_steps=3",
    "checkpoint.save_top_k=-1",
]  # fmt: skip


def run(folder: Path, steps: int, *more: str) -> Path:
    options = [f"exp_root_dir={folder}", f"trainer.max_steps={steps}", *OPTIONS, *more]
    assert launch.main(["--config", str(CONFIG), *options]) == 0
    (checkpoint,) = folder.rglob(f"*step={steps}.ckpt")
    return checkpoint


def test_a_resumed_dataset_update_ends_where_an_uninterrupted_one_does(tmp_path):
    through = torch.load(run(tmp_path / "through", 6), weights_only=True)
    first = run(tmp_path / "first", 3)
    kept = torch.load(first, weights_only=True)["guidance"]["edits"]["images"]
    assert kept and all(image.shape == (32, 32, 3) and image.dtype == torch.uint8 for image in kept.values())
    resumed = torch.load(run(tmp_path / "first", 6, f"resume={first}"), weights_only=True)
    for view, image in through["guidance"]["edits"]["images"].items():
        assert torch.equal(resumed["guidance"]["edits"]["images"][view], image)

    def tensors(node):
        return [t for value in node.values() for t in (tensors(value) if isinstance(value, dict) else [value])]

    for got, want in zip(tensors(resumed["splats"]), tensors(through["splats"]), strict=True):
        if isinstance(want, torch.Tensor):
            torch.testing.assert_close(got, want, rtol=0, atol=0)
