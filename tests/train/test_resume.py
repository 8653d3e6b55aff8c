"""A resumed run is the run that it goes on from, or one line that says where it is not."""

from __future__ import annotations

import shutil

import pytest
import torch
from dreamcatalyst import files
from dreamcatalyst.config import load_config
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.scene.ply import write_ply

HALF = ["trainer.max_steps=4", "checkpoint.every_n_train_steps=2", "checkpoint.save_top_k=-1", "system.report.every=0"]


@pytest.fixture
def half(launch, tmp_path):
    """A run of 4 steps on splats of one's own, and its checkpoint of step 2."""
    ply = write_ply(tmp_path / "mine.ply", make_world("statue").scene[::20])
    given = [*HALF, f"system.gs_source={ply}", "system.anchor.kind=source"]
    trial = launch("closed-form.yaml", *given, name="half")
    (checkpoint,) = (trial / "ckpts").glob("*step=2.ckpt")
    return trial, checkpoint, given


CHANGES = {
    "system.prompt_processor.prompt": "Make it night",
    "system.guidance.rule": "pds",
    "system.guidance.preset": "published-3dgs",
    "system.guidance.guidance_scale": "3",
    "system.guidance.prior.s": "0.1",
    "system.seed": "5",
    "seed": "7",
    "data.source": "demo:sundial",
    "data.width": "32",
    "data.test_every": "4",
    "data.batch_size": "2",
    "system.anchor.kind": "none",
    "system.anchor.weight_init": "0.7",
    "system.mask.kind": "box",
    "system.learning_rates.sh0": "0.01",
    "system.densify.every": "2",
    "trainer.precision": "64",
}


def test_what_makes_another_run_is_refused_with_both_values(launch, half, capsys):
    trial, checkpoint, given = half
    before = {path: path.read_bytes() for path in trial.rglob("*") if path.is_file()}
    for key, value in CHANGES.items():
        more = ["system.mask.options={center: [0, 0, 0], radius: 1}"] if key == "system.mask.kind" else []
        launch("closed-form.yaml", *given, f"{key}={value}", *more, f"resume={checkpoint}", status=2)
        told = capsys.readouterr().err.splitlines()[-1]
        assert told.startswith("error: resume: this is not the run of"), told
        assert f"{key} was " in told and " and is now " in told and value in told, told
        assert f"system.gs_source={trial / 'save' / 'last.ply'} without resume=" in told
    assert {path: path.read_bytes() for path in trial.rglob("*") if path.is_file()} == before


def test_what_is_no_part_of_the_run_may_change(launch, half, capsys):
    _, checkpoint, given = half
    free = [
        "system.report.every=1",
        "system.report.views=2",
        "system.renderer.cache_mib=1",
        "system.source_cache_mib=2",
    ]
    free += ["trainer.log_every_n_steps=1", "trainer.num_sanity_val_steps=0", "checkpoint.minutes=7", "tag=another"]
    launch("closed-form.yaml", *given, *free, f"resume={checkpoint}", "trainer.max_steps=6")
    told = capsys.readouterr().err
    assert "the run was of 4 steps and is now of 6: from step 2 on, its schedules go over the new length" in told
    assert not (checkpoint.parents[2] / "another").exists()


def test_other_splats_of_the_same_name_are_refused_and_the_same_of_another_are_not(launch, half, capsys, tmp_path):
    _, checkpoint, given = half
    moved = shutil.copy(tmp_path / "mine.ply", tmp_path / "moved.ply")
    write_ply(tmp_path / "mine.ply", make_world("statue").scene[1::20])
    launch("closed-form.yaml", *given, f"resume={checkpoint}", status=2)
    assert "the content of system.gs_source" in capsys.readouterr().err
    launch("closed-form.yaml", *given, f"resume={checkpoint}", f"system.gs_source={moved}")


def test_a_finished_run_says_so(launch, half, capsys):
    trial, _, given = half
    last = trial / "ckpts" / "last.ckpt"
    launch("closed-form.yaml", *given, f"resume={last}", status=2)
    told = capsys.readouterr().err
    assert "is of step 4, and trainer.max_steps is 4: there is nothing left to train" in told
    assert "trainer.max_steps=8" in told and "--test" in told


def test_from_the_parsed_config_a_longer_run_does_not_validate_on_its_way(launch, half, capsys):
    trial, checkpoint, _ = half
    parsed = trial / "configs" / "parsed.yaml"
    longer = load_config(parsed, cli_args=["trainer.max_steps=9", f"resume={checkpoint}"])
    assert longer.trainer["val_check_interval"] == 10
    launch(str(parsed), f"resume={checkpoint}", "trainer.max_steps=9")
    assert not list((trial / "save").glob("it*-[0-9]*.png")), "a validation's pictures"
    assert files.load(trial / "ckpts" / "last.ckpt")[0]["global_step"] == 9


def test_a_checkpoint_of_an_earlier_version_goes_on_with_a_notice_and_is_compared_by_the_yaml(launch, half, capsys):
    trial, checkpoint, given = half
    old = torch.load(checkpoint, weights_only=True)
    del old["made_by"]
    torch.save(old, checkpoint)
    launch("closed-form.yaml", *given, f"resume={checkpoint}", "system.guidance.rule=pds", status=2)
    assert "system.guidance.rule was 'dreamcatalyst' and is now 'pds'" in capsys.readouterr().err
    launch("closed-form.yaml", *given, f"resume={checkpoint}")
    assert "carries no digest" in capsys.readouterr().err
    alone = shutil.copy(checkpoint, trial.parents[1] / "alone.ckpt")
    launch("closed-form.yaml", *given, f"resume={alone}", "tag=alone")
    assert "does not say what made it" in capsys.readouterr().err


def test_a_damaged_checkpoint_is_named_with_what_else_there_is(launch, half, capsys):
    trial, checkpoint, given = half
    flipped = bytearray(checkpoint.read_bytes())
    flipped[len(flipped) // 2] ^= 1
    for content in (bytes(flipped), bytes(flipped[: len(flipped) // 2]), b"", b"PK\x03\x04 and so on", b"\x80\x02}."):
        checkpoint.write_bytes(content)
        for mode in ("--train", "--test", "--export"):
            launch("closed-form.yaml", *given, f"resume={checkpoint}", mode=mode, status=2)
            told = capsys.readouterr().err.splitlines()[-1]
            assert str(checkpoint) in told and f"resume={trial / 'ckpts' / 'last.ckpt'}" in told
            assert f"system.gs_source={trial / 'save' / 'last.ply'}" in told


@pytest.mark.parametrize("lacking", ["optimizer_states", "run", "guidance", "splats", "global_step", "loops"])
def test_a_checkpoint_that_lacks_something_is_refused(launch, half, capsys, lacking):
    _, checkpoint, given = half
    state, _ = files.load(checkpoint)
    del state[lacking]
    files.save(checkpoint, state)
    launch("closed-form.yaml", *given, f"resume={checkpoint}", status=2)
    assert capsys.readouterr().err.splitlines()[-1].startswith("error: resume: ")


def test_to_test_an_earlier_checkpoint_does_not_replace_the_result(launch, half):
    trial, checkpoint, given = half
    before = (trial / "save" / "last.ply").read_bytes()
    launch("closed-form.yaml", *given, f"resume={checkpoint}", mode="--test")
    assert (trial / "save" / "last.ply").read_bytes() == before
    assert (trial / "save" / "it2-test" / "point_cloud.ply").is_file()


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("trainer.limit_train_batches=2", "trainer.limit_train_batches: leave it out"),
        ("trainer.limit_train_batches=0", "trainer.limit_train_batches: leave it out"),
        ("trainer.overfit_batches=1", "trainer.overfit_batches: leave it out"),
        ("trainer.strategy=ddp", "trainer.strategy: got 'ddp', expected auto"),
        ("trainer.max_epochs=0", "no step was taken"),
        ("trainer.max_steps=true", "trainer.max_steps: got True (bool)"),
        ("trainer.max_steps=abc", "trainer.max_steps: got 'abc' (str)"),
        ("checkpoint.minutes=-1", "checkpoint.minutes: got -1"),
        ("checkpoint.minutes=often", "checkpoint.minutes: got 'often'"),
    ],
)
def test_a_length_that_cannot_be_is_refused(launch, capsys, option, said):
    launch("closed-form.yaml", "trainer.max_steps=2", option, status=2)
    told = capsys.readouterr().err
    assert said in told.splitlines()[-1] and "Traceback" not in told
