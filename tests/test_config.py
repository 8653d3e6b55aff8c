"""Configs: what is taken, what is refused and in which words, and what a schedule is worth at a step."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Annotated

import pytest
from dreamcatalyst.config import (
    AtLeastOne,
    ExperimentConfig,
    Fraction,
    Number,
    Positive,
    Range,
    Rate,
    Scalar,
    Seed,
    check,
    corners,
    largest,
    load_config,
    merge_config,
    parse,
    read_config,
    save_config,
    value,
)
from dreamcatalyst.errors import ConfigError
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf, ValidationError


class Colour(Enum):
    RED = 1
    BLUE = 2


@dataclass(frozen=True)
class Inner:
    until: int = 100
    threshold: Scalar = 0.1
    mode: str = field(default="plain", metadata={"choices": ["plain", "fancy"]})


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner = field(default_factory=lambda: Inner(until=7))
    size: tuple[int, int] | None = None
    steps: list[float] = field(default_factory=list)
    limit: float | None = None
    either: int | str = 3
    colour: Colour = Colour.RED
    flag: bool = False
    free: dict = field(default_factory=dict)

    def __post_init__(self):
        if self.limit is not None and self.limit < 0:
            raise ConfigError(f"limit: got {self.limit}, expected 0 or more")


def test_every_kind_of_field_is_filled():
    given = {
        "name": 2024,
        "inner": {"threshold": [0, 0.1, 0.9, 1500], "mode": "fancy"},
        "size": [3, 4],
        "steps": [1, 2.5],
        "limit": "1e-3",
        "either": "many",
        "colour": "BLUE",
        "flag": True,
        "free": {"anything": [1]},
    }
    filled = parse(Outer, given, "system")
    expected = Outer(
        name="2024",
        inner=Inner(until=7, threshold=(0, 0.1, 0.9, 1500), mode="fancy"),  # `until` is the field's own default
        size=(3, 4),
        steps=[1.0, 2.5],
        limit=0.001,
        either="many",
        colour=Colour.BLUE,
        flag=True,
        free=filled.free,
    )
    assert filled == expected and filled.free == {"anything": [1]}
    assert parse(Outer, OmegaConf.create(given), "system") == filled


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ({}, "system.name: a value is needed (str)"),
        ({"name": "???"}, "system.name: a value is needed (str)"),
        ({"name": None}, "system.name: got None (NoneType), expected str"),
        ({"nam": "x"}, "system: unknown key 'nam'. Did you mean 'name'?"),
        ({"inner": {"utnil": 3}}, "system.inner: unknown key 'utnil'. Did you mean 'until'? Known: mode, threshold"),
        ({"inner": {"until": "soon"}}, "system.inner.until: got 'soon' (str), expected int"),
        ({"inner": {"until": 1.5}}, "system.inner.until: got 1.5 (float), expected int"),
        ({"inner": {"until": True}}, "system.inner.until: got True (bool), expected int"),
        ({"inner": {"until": [1]}}, "system.inner.until: got [1] (list), expected int"),
        ({"inner": 3}, "system.inner: got 3 (int), expected keys of their own: until, threshold, mode"),
        ({"inner": {"mode": "fanzy"}}, "system.inner.mode: unknown mode value 'fanzy'. Did you mean 'fancy'?"),
        (
            {"inner": {"threshold": None}},
            "system.inner.threshold: got None (NoneType), expected a number or a schedule",
        ),
        ({"inner": {"threshold": [1, 2]}}, "system.inner.threshold: a schedule of 2 numbers"),
        ({"inner": {"threshold": [1, 2, 3, 4, 5]}}, "system.inner.threshold: a schedule of 5 numbers"),
        ({"inner": {"threshold": [0, 1, "x"]}}, "system.inner.threshold: a schedule holds numbers only, and 'x'"),
        ({"inner": {"threshold": [9, 0, 1, 5]}}, "system.inner.threshold: the times of a schedule must increase"),
        ({"size": [3]}, "system.size: got"),
        ({"steps": ["a"]}, "system.steps[0]: got 'a' (str), expected float"),
        ({"colour": "GREEN"}, "system.colour: got 'GREEN' (str)"),
        ({"free": 3}, "system.free: got 3 (int), expected dict"),
        ({"limit": -1}, "system: limit: got -1.0, expected 0 or more"),
    ],
)
def test_what_is_refused_is_named_with_its_place(bad, said):
    section = {"name": "x", **bad} if bad and "nam" not in bad else bad
    with pytest.raises(ConfigError) as error:
        parse(Outer, section, "system")
    assert said in str(error.value)


@dataclass(frozen=True)
class Ranges:
    part: Fraction = 0.5
    beta: Annotated[float, Range("[0, 1)")] = 0.9
    rate: Rate = 1.0
    size: Positive | None = None
    colour: tuple[Fraction, Fraction, Fraction] = (0.0, 0.0, 0.0)
    widths: tuple[AtLeastOne, ...] = (1,)
    shift: Number = 0.0
    seed: Seed = 0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"part": 1.5}, "system.part: got 1.5 (float), expected a number in [0, 1]."),
        ({"part": "nan"}, "system.part: got 'nan' (str), expected a finite number."),
        ({"part": True}, "system.part: got True (bool), expected float."),
        ({"beta": 1}, "system.beta: got 1.0 (float), expected a number in [0, 1)."),
        ({"rate": -1}, "system.rate: got -1 (int), expected 0 or more."),
        ({"rate": [0, 1.0, -2.0, 10]}, "system.rate: got -2.0 in [0, 1.0, -2.0, 10] (list), expected 0 or more."),
        ({"rate": float("inf")}, "system.rate: got inf (float), expected finite numbers."),
        ({"rate": [0, 1.0, float("nan"), 10]}, "system.rate: got [0, 1.0, nan, 10] (list), expected finite numbers."),
        ({"rate": 10**400}, ", expected finite numbers."),
        ({"size": 0}, "system.size: got 0.0 (float), expected more than 0."),
        ({"colour": [0, 2, 0]}, "system.colour[1]: got 2.0 (float), expected a number in [0, 1]."),
        ({"colour": [0, True, 0]}, "system.colour[1]: got True (bool), expected float."),
        ({"colour": [0, 0]}, "system.colour: got 2 values, expected 3 (tuple[float, float, float])."),
        ({"colour": 0.5}, "system.colour: got 0.5 (float), expected tuple[float, float, float]."),
        ({"colour": (0, 0, -1)}, "system.colour[2]: got -1.0 (float), expected a number in [0, 1]."),
        ({"rate": (0, 1.0, -2.0, 10)}, "system.rate: got -2.0 in "),
        ({"widths": [4, 0]}, "system.widths[1]: got 0 (int), expected 1 or more."),
        ({"shift": 10**400}, ", expected float."),
        ({"shift": float("-inf")}, "system.shift: got -inf (float), expected a finite number."),
        ({"seed": -1}, "system.seed: got -1 (int), expected a number in [0, 4294967295]."),
    ],
)
def test_a_number_outside_of_its_range_is_refused(given, said):
    with pytest.raises(ConfigError) as error:
        parse(Ranges, given, "system")
    assert said in str(error.value)


def test_the_ends_of_a_range_are_inside_where_its_brackets_are_square():
    ends = {"part": 1, "beta": 0, "rate": [0, 0.0, 1.0, 5, 0.0, 9], "colour": [0, 1, 0.5], "size": 1e-300, "shift": -3}
    filled = parse(Ranges, ends)
    assert (filled.part, filled.beta, filled.size, filled.shift) == (1.0, 0.0, 1e-300, -3.0)
    assert filled.colour == (0.0, 1.0, 0.5) and filled.rate == (0, 0.0, 1.0, 5, 0.0, 9)
    # A schedule's times may be anything; only its values are in the range.
    assert parse(Ranges, {"rate": [-5, 1.0, 2.0, 10]}).rate == (-5, 1.0, 2.0, 10)


def test_the_hosts_parser_sees_ranges_as_plain_numbers():
    node = OmegaConf.structured(Ranges(part=0.25))
    assert node.part == 0.25 and OmegaConf.merge(node, {"part": 7}).part == 7.0
    with pytest.raises(ValidationError):
        OmegaConf.merge(node, {"part": "much"})


def test_a_registered_class_is_validated_with_its_parts():
    class System:
        parts = {"inner": Inner}

        @dataclass
        class Config:
            rate: Scalar = 1.0
            inner: dict = field(default_factory=dict)

    assert check(System, {"inner": {"until": 5}}, "system") == {"inner": Inner(until=5)}
    assert check(System, {}, "system") == {"inner": Inner()}
    with pytest.raises(ConfigError, match=r"system\.inner: unknown key 'unitl'\. Did you mean 'until'"):
        check(System, {"inner": {"unitl": 5}}, "system")
    with pytest.raises(ConfigError, match="system: unknown key 'innre'"):
        check(System, {"innre": {}}, "system")

    class Outermost:
        parts = {"system": System}

        @dataclass
        class Config:
            system: dict = field(default_factory=dict)

    with pytest.raises(ConfigError, match=r"run\.system\.inner\.until"):
        check(Outermost, {"system": {"inner": {"until": "x"}}}, "run")


# --- schedules: the facts are those of threestudio's C


@pytest.mark.parametrize(
    ("schedule", "epoch", "step", "expected"),
    [
        (0.3, 9, 9, 0.3),
        ([1.0, 3.0, 10], 0, 5, 2.0),  # from step 0
        ([10, 1.0, 3.0, 20], 0, 5, 1.0),  # before the start
        ([10, 1.0, 3.0, 20], 0, 15, 2.0),
        ([10, 1.0, 3.0, 20], 0, 99, 3.0),  # after the end
        ([0, 10.0, 1000.0, 5000], 0, 5000, 1000.0),  # an int at the end: steps
        ([0, 10.0, 1000.0, 5000.0], 0, 5000, 10.0),  # a float at the end: epochs
        ([0, 10.0, 1000.0, 5000.0], 2500, 0, 505.0),
        ([0, 0.0, 1.0, 10, 5.0, 20], 0, 5, 0.5),  # piecewise: (0, 0) (10, 1) (20, 5)
        ([0, 0.0, 1.0, 10, 5.0, 20], 0, 10, 1.0),
        ([0, 0.0, 1.0, 10, 5.0, 20], 0, 15, 3.0),
        ([0, 0.0, 1.0, 10, 5.0, 20, 5.0, 30], 0, 99, 5.0),
    ],
)
def test_a_schedule_has_the_value_that_threestudio_gives_it(schedule, epoch, step, expected):
    assert value(schedule, epoch, step) == pytest.approx(expected)
    assert value(OmegaConf.create({"s": schedule}).s, epoch, step) == pytest.approx(expected)


def test_the_exponential_schedule_is_geometric():
    assert value([0, 1.0, 100.0, 10], 0, 5, "exp") == pytest.approx(10.0)
    with pytest.raises(ConfigError, match="needs positive values"):
        value([0, 0.0, 1.0, 10], 0, 5, "exp")
    with pytest.raises(ConfigError, match="Did you mean 'linear'"):
        value([0, 0.0, 1.0, 10], 0, 5, "lniear")


@given(
    st.lists(st.tuples(st.integers(1, 50), st.floats(-9, 9)), min_size=2, max_size=6),
    st.integers(-10, 400),
)
def test_a_piecewise_schedule_is_the_polyline_through_its_corners(gaps, step):
    times = [sum(gap for gap, _ in gaps[: i + 1]) for i in range(len(gaps))]
    values = [v for _, v in gaps]
    schedule = [times[0], values[0]] + [x for t, v in zip(times[1:], values[1:], strict=True) for x in (v, t)]
    i = max(sum(t <= step for t in times) - 1, 0)
    if step <= times[0] or i == len(times) - 1:
        expected = values[0] if step <= times[0] else values[-1]
    else:
        along = (step - times[i]) / (times[i + 1] - times[i])
        expected = values[i] * (1 - along) + values[i + 1] * along
    assert math.isclose(value(schedule, 0, step), expected, abs_tol=1e-9)
    assert largest(schedule) == max(values)
    assert [value(schedule, t, t) for t in corners(schedule)] == pytest.approx(values)


# --- the experiment


@pytest.fixture
def written(tmp_path):
    """A function that writes a YAML file and returns its path."""

    def write(text: str, name: str = "run.yaml") -> Path:
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def test_later_files_and_arguments_override_and_interpolations_resolve(written):
    base = written("tag: a\ntimestamp: '@t'\nsystem: {steps: 10, twice: '${mul:${system.steps},2}', rate: 1}")
    more = written("system: {rate: 2}", "more.yaml")
    config = load_config(base, more, cli_args=["system.steps=50", "system.extra=[0, 1.0, 2]"], n_gpus=1)
    assert config.system == {"steps": 50, "twice": 100, "rate": 2, "extra": [0, 1.0, 2]}
    assert (config.exp_dir, config.trial_name) == ("outputs/default", "a@t")


def test_loading_makes_no_folder(written, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = load_config(written("name: x"))
    assert config.trial_dir.startswith("outputs/x/@2") and not (tmp_path / "outputs").exists()


@pytest.mark.parametrize(
    "prompt",
    [
        "Make it sunset",
        "turn him into a 'clown', please",
        "'tis autumn",
        "night: a full moon",
        "- dashed",
        "it's #1 = the best",
        "yes",
        'a "quoted" word',
        "as it is, but {bright}",
        "Costs ${5}",
        "Costs ${",
        "${HOME}",
        "${system.seed}",
        "a \\${b} and \\\\${",
    ],
)
def test_a_prompt_arrives_as_it_was_typed(written, prompt):
    config = load_config(written("name: x"), cli_args=[f"system.prompt_processor.prompt={prompt}"])
    assert config.system.prompt_processor.prompt == prompt


def test_a_prompt_in_words_survives_all_that_reads_it_again(written, tmp_path):
    """Where it is part of a tag, where the run's config is saved and loaded, and where a section is parsed."""

    @dataclass
    class Words:
        prompt: str = ""

    base = written("tag: x${rmspace:${system.p.prompt},_}\nsystem: {p: {prompt: a}, seed: 3, same: '${system.seed}'}")
    config = load_config(base, cli_args=["system.p.prompt=Costs ${5}"])
    assert config.tag == "xCosts_${5}" and config.system.same == 3
    assert parse(Words, config.system.p).prompt == "Costs ${5}"
    save_config(config, tmp_path / "parsed.yaml")
    assert load_config(tmp_path / "parsed.yaml") == config


def test_an_interpolation_may_be_typed(written):
    base = written("tag: t\nsystem: {seed: 3}")
    config = load_config(
        base, cli_args=["system.a=${system.seed}", "system.b=${add:${system.seed}, 1}", "tag=a${system.seed}"]
    )
    assert config.system == {"seed": 3, "a": 3, "b": 4} and config.tag == "a3"


def test_other_arguments_are_read_as_yaml(written):
    arguments = ["a=1e-3", "b=null", "c={p: 1}", "d=true", "e=-1", "f=[a, 'b c']", "g='12'"]
    config = load_config(written("name: x"), cli_args=[f"system.{argument}" for argument in arguments])
    expected = {"a": 0.001, "b": None, "c": {"p": 1}, "d": True, "e": -1, "f": ["a", "b c"], "g": "12"}
    assert config.system == expected


@pytest.mark.parametrize(
    ("text", "arguments", "said"),
    [
        ("nmae: x", [], "run.yaml: unknown key 'nmae'. Did you mean 'name'?"),
        ("name: x", ["nmae=y"], "config: unknown key 'nmae'. Did you mean 'name'?"),
        ("", [], "run.yaml: is empty, expected keys such as data_type"),
        ("# nothing yet", [], "run.yaml: is empty"),
        ("name: x", ["system..a=1"], "'system..a' is no key: a part of it is empty"),
        ("name: x", ["system.=1"], "'system.' is no key: a part of it is empty"),
        ("name: x", ["system.a=${system.b}"], "system.a: "),
        ("seed: x", [], "seed: got 'x' (str), expected int"),
        ("data: 3", [], "data: got 3 (int), expected dict"),
        ("name: ???", [], "name: a value is needed"),
        ("tag: '${data.source}'\ndata:\n  source: ???", [], "data.source: a value is needed, and none is given"),
        ("system: {a: '${system.b}'}", [], "system.a: "),
        ("a: [1", [], ": not valid YAML: "),
        ("a: 1\na: 2", [], "run.yaml:2:1: not valid YAML: found duplicate key"),
        ("- a", [], "run.yaml: got a list"),
        ("", [], "run.yaml: is empty, expected keys such as data_type"),
        ("# nothing yet", [], "run.yaml: is empty"),
        ("hello", [], "run.yaml: got a single value"),
        ("5", [], "run.yaml: got a single value"),
        ("name: x", ["system..a=1"], "'system..a' is no key: a part of it is empty"),
        ("name: x", ["system.=1"], "'system.' is no key: a part of it is empty"),
        ("tag: 'x${system.a}'", ["system.a=Costs ${5}"], "system.a: Interpolation key '5' not found, in Costs ${5}"),
        ("system: 5", [], "system: got 5 (int), expected dict"),
        ("trainer: {max_steps: abc, x: '${add:${trainer.max_steps},1}'}", [], "trainer.max_steps: got 'abc'"),
        ("trainer: {max_steps: true}", [], "trainer.max_steps: got True (bool), expected a whole number"),
        ("trainer: {max_steps: 1.5}", [], "trainer.max_steps: got 1.5 (float), expected a whole number"),
        ("trainer: {max_steps: 0}", [], "trainer.max_steps: got 0 (int), expected a whole number, 1 or more"),
        ("use_timestamp: false", [], "tag: empty, and use_timestamp is false"),
        ("name: x", ["sunset"], "'sunset' on the command line is neither a flag nor key=value"),
        ("name: x", ["system.a=[1"], "system.a: '[1' is not a valid list or mapping"),
        ("name: x", ["resume=no.ckpt"], "resume: there is no checkpoint 'no.ckpt'"),
    ],
)
def test_a_run_that_cannot_be_is_refused(written, text, arguments, said):
    with pytest.raises(ConfigError) as error:
        load_config(written(text), cli_args=arguments)
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("argument", "meant"),
    [
        ("renderer.backend=cpu", "'system.renderer.backend'?"),
        ("renderer.backen=cpu", "'system.renderer'?"),
        ("max_steps=5", "'trainer.max_steps'?"),
        ("every=5", "'system.densify.every' or 'system.report.every'?"),
        ("sed=5", "'seed'?"),
    ],
)
def test_a_key_without_its_section_is_told_with_it(written, argument, meant):
    below = ["renderer", "renderer.backend", "densify.every", "report.every"]
    merged = merge_config(written("name: x"), cli_args=[argument])
    with pytest.raises(ConfigError) as error:
        read_config(merged, lambda: [*(f"system.{key}" for key in below), "trainer.max_steps"])
    assert f"unknown key '{argument.partition('=')[0].partition('.')[0]}'. Did you mean {meant}" in str(error.value)


@pytest.mark.parametrize("text", ["../..", "/", "/etc", "..", "a/b", "\\", "x\0y", "long " * 100, "ü" * 200, " . "])
@pytest.mark.parametrize("key", ["tag", "name", "timestamp"])
def test_no_text_leads_a_run_out_of_its_folder(written, tmp_path, key, text):
    config = load_config(written("name: n\ntag: t"), exp_root_dir=str(tmp_path), **{key: text})
    trial = Path(config.trial_dir)
    assert trial.parent.parent == tmp_path and trial.resolve() == trial
    assert max(len(part.encode()) for part in trial.parts) < 250
    trial.mkdir(parents=True)


def test_long_prompts_that_differ_at_their_end_have_folders_of_their_own(written):
    tags = [f"tag={'Make_it_so_' * 30}{end}" for end in "ab"]
    one, other = (load_config(written("timestamp: now"), cli_args=[tag]).trial_dir for tag in tags)
    assert one != other


def test_what_follows_from_the_length_follows_it_in_the_saved_config_too(written, tmp_path):
    text = "tag: a\ntrainer: {max_steps: 4, val_check_interval: '${add:${trainer.max_steps},1}'}"
    merged = merge_config(written(text))
    config = read_config(merged)
    save_config(config, tmp_path / "parsed.yaml", merged)
    assert load_config(tmp_path / "parsed.yaml") == config
    longer = load_config(tmp_path / "parsed.yaml", cli_args=["trainer.max_steps=9"])
    assert longer.trainer["val_check_interval"] == 10


def test_a_missing_file_is_named_with_its_nearest_neighbour(written, tmp_path, monkeypatch):
    there = written("name: x", "closed-form.yaml")
    with pytest.raises(ConfigError, match=f"there is no file '{tmp_path}/dc-eg.yaml'. Did you mean '{there}'"):
        load_config(tmp_path / "dc-eg.yaml")


def test_a_saved_config_loads_to_the_same_trial(written, tmp_path):
    config = load_config(written("tag: 'a b'\nsystem: {rate: [0, 1.0, 2, 5]}"))
    save_config(config, tmp_path / "parsed.yaml")
    assert load_config(tmp_path / "parsed.yaml") == config


def test_a_resumed_run_stays_in_its_trial(written, tmp_path):
    run = written(f"tag: a\nexp_root_dir: {tmp_path}/outputs")
    first = load_config(run)
    checkpoint = Path(first.trial_dir) / "ckpts" / "last.ckpt"
    for path in (checkpoint, Path(first.trial_dir) / "configs" / "parsed.yaml"):
        path.parent.mkdir(parents=True)
        path.touch()
    for other in ([], ["tag=b"]):
        assert load_config(run, cli_args=[f"resume={checkpoint}", *other]).trial_dir == first.trial_dir
    elsewhere = tmp_path / "elsewhere.ckpt"  # not in a trial's folder: a trial of its own
    elsewhere.touch()
    assert load_config(run, cli_args=[f"resume={elsewhere}"]).trial_name.startswith("a@")


def test_the_experiment_has_the_hosts_fields_and_imports_and_export():
    names = {f for f in ExperimentConfig.__dataclass_fields__}
    assert names == {
        *("name", "description", "tag", "seed", "use_timestamp", "timestamp", "exp_root_dir", "exp_dir", "trial_name"),
        *(
            "trial_dir",
            "n_gpus",
            "imports",
            "resume",
            "data_type",
            "data",
            "system_type",
            "system",
            "trainer",
            "checkpoint",
            "export",
        ),
    }


def test_what_cannot_be_worked_out_names_its_expression(written):
    path = written("trainer:\n  max_epochs: two\n  min_epochs: ${add:${trainer.max_epochs},1}\n")
    with pytest.raises(ConfigError, match=r"trainer\.min_epochs: .*\$\{trainer\.max_epochs\}"):
        load_config(path)


def test_the_name_of_a_source_that_is_left_empty_is_empty(written):
    path = written("tag: x${basename:${data.source}}\ndata:\n  source: null\n")
    assert load_config(path).tag == "x"


@pytest.mark.parametrize(
    "given, said",
    [("system.loss=[]", "system.loss: got [] (list), expected keys of their own"), ("system.loss=[1]", "system.loss:")],
)
def test_a_list_in_the_place_of_a_section_is_refused(tmp_path, given, said):
    (tmp_path / "a.yaml").write_text("tag: x\nsystem: {loss: {lambda_outside: 1.0}}\n", encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_config(tmp_path / "a.yaml", cli_args=[given])
    assert said in str(error.value)


def test_an_overlay_is_merged_over_its_base_wherever_it_lies(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "whole.yaml").write_text("name: whole\ntag: a\nsystem: {a: 1, b: {c: 2, d: given}}\n")
    (tmp_path / "middle.yaml").write_text("base: whole.yaml\nname: middle\nsystem: {b: {c: 3}}\n")
    (tmp_path / "sub/top.yaml").write_text("base: ../middle.yaml\nsystem: {a: 4, b: {d: '???'}}\n")
    config = load_config(tmp_path / "sub/top.yaml", cli_args=["system.b.d=x"])
    assert (config.name, config.tag) == ("middle", "a")
    assert config.system == {"a": 4, "b": {"c": 3, "d": "x"}}
    with pytest.raises(ConfigError, match="system.b.d: a value is needed"):
        load_config(tmp_path / "sub/top.yaml")


def test_bases_that_cannot_be_are_refused(tmp_path):
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first.write_text("base: second.yaml\ntag: a\n")
    with pytest.raises(ConfigError, match=r"first.yaml: base: there is no file '.*second.yaml'"):
        load_config(first)
    second.write_text("base: first.yaml\n")
    with pytest.raises(ConfigError, match=r"second.yaml: base: leads back .*first.yaml over .*second.yaml"):
        load_config(first)


def test_a_choice_that_is_not_in_its_list_is_to_blame_and_not_what_follows_from_it(written):
    path = written(
        "trainer: {max_steps: '${system.steps.${system.mode}}'}\nsystem: {mode: fast, steps: {fast: 3, slow: 5}}"
    )
    assert load_config(path, cli_args=["tag=a", "system.mode=slow"]).trainer["max_steps"] == 5
    with pytest.raises(ConfigError, match=r"system\.mode: unknown value 'fsat'\. Did you mean 'fast'\?"):
        load_config(path, cli_args=["tag=a", "system.mode=fsat"])


def test_options_stay_behind_where_another_kind_is_named(tmp_path):
    """What one kind takes, another does not: options go with their kind, from an overlay as from the command line."""
    path = tmp_path / "a.yaml"
    path.write_text("system: {mask: {kind: box, options: {low: 1}, grow: 2}}")
    texts = ["system.mask.kind=text", "system.mask.options.text=bear"]
    assert merge_config(path, cli_args=texts).system.mask == {"kind": "text", "options": {"text": "bear"}, "grow": 2}
    assert merge_config(path, cli_args=["system.mask.kind=none"]).system.mask.options == {}
    both = merge_config(path, cli_args=["system.mask={kind: box, options: {high: 3}}"]).system.mask.options
    assert both == {"low": 1, "high": 3}  # the same kind: laid over each other, as everything else
