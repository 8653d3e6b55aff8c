"""The work-precision benchmark: what is run in which order, and what its tables say; without running anything."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from dreamcatalyst import plugin
from dreamcatalyst.config import check, load_config, parse
from dreamcatalyst.demo.edits import find_edit, possible
from dreamcatalyst.demo.random_world import HELD_OUT
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.diffusion.api import PRIORS
from dreamcatalyst.guidance.config import GuidanceConfig, chosen_rule, chosen_schedule
from dreamcatalyst.guidance.fixed_point import fixed_point
from dreamcatalyst.guidance.rules import RULES, Rule

from benchmarks import error_vs_time
from benchmarks.precision import balance, cells, curves, document, runner, search, tables

VALUES = {
    "system": {
        "steps": {"fast": 100, "high-quality": 400},
        "guidance": {"guidance_scale": 7.5},
        "learning_rates": {"means": 1e-4, "sh0": 1e-2, "warm_up_steps": 100},
        "densify": {"every": 100, "start": 50, "stop": 0},
    }
}
CASES = (cells.Case("panda", "Make it a panda", (), ablated=True), cells.Case("snow", "Make it snow", ()))


def bench(name: str = "demo", scales: dict[str, float] | None = None, **options) -> cells.Bench:
    families = ("dreamcatalyst", "pds")
    tuned_on = (cells.Case("other", "Make it sunset", ()),)
    return cells.Bench(name, name, "x.yaml", VALUES, families, CASES, tuned_on, scales=scales or {}, **options)


class Results(dict):
    """Cells with invented results: `better` says what a cell ends with."""

    def __init__(self, better=lambda cell: 20.0):
        super().__init__()
        self.better = better

    def lookup(self, cell):
        return self.get(cell)

    def run(self, cell):
        end = self.better(cell)
        self[cell] = {"key": str(len(self)), "wall": 10.0, "step": [0, 5, 10], "seconds": [0.0, 1.0, 2.0]}
        self[cell] |= {"error": [10.0, (10 + end) / 2, end], "outside": None}

    def run_all(self, settings, limit=10**6):
        made = []
        for cell in cells.remaining(settings, self.lookup):
            if len(made) == limit:
                break
            self.run(cell)
            made.append(cell)
        return made


def value(cell: cells.Cell, key: str) -> str:
    """What the command line finally says of `key`."""
    return [text.partition("=")[2] for text in cell.overrides if text.startswith(f"{key}=")][-1]


# --- the search


def climb(function, trials=9, axes=2):
    tried = {}
    while (point := search.propose(tried, trials, axes)) is not None:
        tried[point] = function(*point)
    return tried


def test_the_search_comes_to_the_top_of_a_hill():
    tried = climb(lambda rate, scale: -((rate - 1) ** 2) - (scale + 1) ** 2)
    assert search.best(tried) == (1, -1) and len(tried) < 9  # all around it was tried


def test_the_search_spends_no_more_than_its_trials_and_stops_at_a_top():
    assert list(climb(lambda rate, scale: -abs(rate) - abs(scale), 5)) == [(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)]
    assert len(climb(lambda rate, scale: rate, 4)) == 4
    assert list(climb(lambda rate, scale: -abs(rate), 9, axes=1)) == [(0, 0), (1, 0), (-1, 0)]
    assert climb(lambda rate, scale: 0.0, 0) == {} and search.best({}) == (0, 0)


def test_the_search_leaves_what_fails():
    assert search.best(climb(lambda rate, scale: -math.inf if rate > 0 else scale, 5))[0] == 0


# --- order, budget, going on


def test_tuning_comes_first_and_seeds_last():
    settings, results = cells.Settings((bench(),), trials=3), Results()
    order = results.run_all(settings)
    assert len(order) == len(set(order)) == sum(cells.planned(settings).values())
    assert [cell.group for cell in order[:6]] == ["tuning"] * 6 and order[6].group != "tuning"
    assert [cell.label.split()[0] for cell in order[:4]] == ["dreamcatalyst", "pds", "dreamcatalyst", "pds"]
    seeds = [cell.seed for cell in order[6:]]
    assert seeds == sorted(seeds) and set(seeds) == {0, 1, 2}
    first = [(cell.case, cell.label) for cell in order[6:12]]
    names = ("dreamcatalyst fast", "dreamcatalyst", "pds")
    assert first == [(case, name) for case in ("panda", "snow") for name in names]


def test_what_says_most_is_tuned_and_run_before_the_rest_is():
    more = replace(bench(), families=("sds", "pds", "dreamcatalyst"))
    order = [cell.label for cell in Results().run_all(cells.Settings((more,), trials=2, ablations=False))]
    assert order.index("pds") < order.index("pds long") < order.index("sds +0 +0") < order.index("sds")


def test_edits_of_several_benches_come_in_turn():
    both = cells.Settings((bench("a"), bench("b", {"dreamcatalyst": 7.5, "pds": 70.0})), trials=0, ablations=False)
    places = list(dict.fromkeys((cell.bench, cell.case) for cell in Results().run_all(both)))
    assert places == [("a", "panda"), ("b", "panda"), ("a", "snow"), ("b", "snow")]


@pytest.mark.parametrize("limit", [1, 4, 9, 20])
def test_an_interrupted_table_goes_on_as_if_it_had_not_been(limit):
    settings = cells.Settings((bench(),), trials=4)
    whole, parts, pieces = Results(), Results(), []
    whole.run_all(settings)
    while made := parts.run_all(settings, limit):
        pieces += made
    assert pieces == list(whole)
    assert len(cells.finished(settings, parts.lookup)) == len(whole)


def test_methods_run_with_what_was_best_on_other_scenes():
    better = lambda cell: 20.0 if "pds +1 +0" in cell.label else 15.0  # noqa: E731
    order = Results(better).run_all(cells.Settings((bench(),), trials=3))
    pds = next(cell for cell in order if cell.label == "pds")
    ours = next(cell for cell in order if cell.label == "dreamcatalyst")
    assert (value(pds, "system.learning_rates.means"), value(pds, "system.learning_rates.sh0")) == ("0.0003", "0.03")
    assert not any("learning_rates.means" in text for text in ours.overrides)
    assert {cell.case for cell in order if cell.group == "tuning"} == {"other"}


def test_on_the_closed_form_only_the_rates_are_tuned():
    known = bench(scales={"dreamcatalyst": 7.5, "pds": 70.3})
    order = Results().run_all(cells.Settings((known,), trials=5))
    tuning = [cell for cell in order if cell.group == "tuning"]
    assert len(tuning) == 6  # two families, three trials each
    assert {value(cell, "system.guidance.guidance_scale") for cell in tuning} == {"7.5", "70.3"}
    assert not any("freeu" in text for cell in order if cell.group == "methods" for text in cell.overrides)


def test_lengths_scale_with_all_that_counts_steps():
    cell = next(c for c in Results().run_all(cells.Settings((bench(length=0.5),), trials=0)) if c.label == "pds")
    assert value(cell, "trainer.max_steps") == "200" and value(cell, "system.report.every") == "12"
    assert value(cell, "system.learning_rates.warm_up_steps") == "50"
    assert value(cell, "system.densify.every") == "50" and value(cell, "system.densify.start") == "25"
    assert not any("densify.stop" in text for text in cell.overrides)


def test_a_rate_that_is_a_schedule_goes_over_the_run_that_it_is_in():
    assert cells.scaled(0.01, 3.0, 50) == "0.03"
    assert cells.scaled([0, 0.05, 0.005, 400], 3.0, 50) == "[0,0.15,0.015,50]"


def test_seeds_reach_views_and_noise():
    order = Results().run_all(cells.Settings((bench(),), seeds=(3,), trials=0))
    assert {(value(cell, "seed"), value(cell, "data.seed")) for cell in order} == {("3", "3")}


def test_a_cell_begins_only_where_it_is_likely_to_end():
    assert cells.affordable(0, 60, []) and cells.affordable(40, 60, [15, 25])
    assert not cells.affordable(45, 60, [15, 25]) and not cells.affordable(61, 60, [])


def test_every_rule_takes_part_and_every_method_is_a_family():
    rules = {setting.removeprefix("rule=") for family in cells.FAMILIES.values() for setting in family.settings[:1]}
    assert rules == set(RULES.names())
    assert {method.family for method in cells.METHODS} == set(cells.FAMILIES)
    drawn = {name for names in document.PANELS.values() for name in names}
    assert drawn <= {method.name for method in cells.METHODS} | set(cells.ABLATIONS)
    assert max(map(len, document.PANELS.values())) <= 6


# --- curves, times and ratios


def line(*errors: float, seconds: float = 10.0, **options) -> dict:
    """A run of equally long rows."""
    steps = list(range(len(errors)))
    times = [seconds * step / steps[-1] for step in steps]
    return {"step": steps, "seconds": times, "error": list(errors), "outside": None, **options}


def test_the_median_and_the_spread_of_seeds():
    curve = curves.track([line(10, 20), line(10, 26, seconds=14), line(10, 23, outside=30.0), line(1, 2, failed="NaN")])
    assert (curve.error[-1], curve.low[-1], curve.high[-1]) == (23, 20, 26)
    assert (curve.seconds[-1], curve.outside, curve.runs, curve.failed) == (10, 30.0, 3, 1)
    assert curves.track([line(1, 2, failed="NaN")]) is None


def test_the_time_to_an_error_is_the_first_and_lies_on_a_straight_line():
    curve = curves.track([line(10, 20, 15, 30)])
    assert curves.reach(curve, 15) == pytest.approx(10 / 6)
    assert curves.reach(curve, 10) == 0 and curves.reach(curve, 31) is None
    assert curves.reach(curve, 25) == pytest.approx(20 / 3 + 10 / 3 * 10 / 15)


def test_levels_are_shares_of_the_way_to_the_best():
    assert curves.levels([curves.track([line(10, 20)]), curves.track([line(10, 30)])], (0.5, 1)) == [20, 30]


def test_ratios_count_to_the_same_error():
    ours = curves.track([line(10, 20, 20 + curves.NEAR, seconds=10)])  # at 20 dB after 5 s
    slow = curves.track([line(10, 20, seconds=50)])
    assert str(curves.ratio(ours, [slow])) == "10"
    longer = curves.track([line(10, 15, 18, seconds=200)])
    assert str(curves.ratio(ours, [longer, slow])) == "10"  # the fastest of a method's lengths
    assert str(curves.ratio(ours, [longer])) == "> 40"  # the whole run was not enough
    assert curves.ratio(curves.track([line(10, 9)]), [slow]) is None


def test_the_median_of_ratios_is_a_bound_where_it_depends_on_what_was_never_reached():
    finite, bound = curves.Ratio, lambda x: curves.Ratio(x, reached=False)
    assert str(curves.middle([finite(2.0), finite(4.0), bound(9.0)])) == "4"
    assert str(curves.middle([finite(2.0), bound(3.0), bound(9.0)])) == "> 3"
    assert str(curves.middle([finite(2.0), finite(8.0), bound(3.0)])) == "> 3"
    assert curves.middle([]) is None


def test_the_papers_ratios_are_its_steps_times_our_costs():
    seconds = {"dreamcatalyst fast": 10, "dreamcatalyst": 10, "pds": 8}  # of equally many steps
    tracks = {"panda": {name: curves.track([line(10, 20, seconds=value)]) for name, value in seconds.items()}}
    rows = [row.split(" | ") for row in tables.claims_table(tracks).splitlines()[2:]]
    assert [row[1:4] for row in rows] == [["23", "24", "0.8"], ["8", "8", "0.8"]]  # there is no run of in2n


# --- the document


@pytest.fixture(scope="module")
def whole():
    settings = cells.Settings((bench(),), seeds=(0, 1), trials=3)
    results = Results(lambda cell: 20.0 + cell.seed + len(cell.label))
    results.run_all(settings)
    return settings, results


def test_prose_is_kept_and_tables_are_written_anew(whole, tmp_path):
    settings, results = whole
    path = tmp_path / "error-vs-time.md"
    document.write(path, settings, results.lookup, ["edits of a real capture: no folder"])
    text = path.read_text()
    assert "Left out: edits of a real capture: no folder." in text and "| pds long |" in text
    assert (tmp_path / "error-vs-time-demo-panda.svg").read_text().count("<polygon") >= 3
    path.write_text(text.replace("## Measured", "It holds.\n\n## Measured").replace("| pds long |", "| gone |"))
    document.write(path, settings, results.lookup, [])
    again = path.read_text()
    assert "It holds." in again and "| gone |" not in again and "Left out" not in again
    assert again.count(document.BEGIN) == again.count(document.END) == 1
    path.write_text("prose alone\n")
    with pytest.raises(SystemExit, match="the marks are missing"):
        document.write(path, settings, results.lookup, [])


def test_every_table_has_one_width(whole, tmp_path):
    settings, results = whole
    for table in document.generated(settings, results.lookup, [], tmp_path / "x.md").split("\n\n"):
        if table.startswith("|"):
            assert len({row.count("|") for row in table.splitlines()}) == 1, table


def test_a_table_that_has_just_begun_can_be_written(tmp_path):
    settings, results = cells.Settings((bench(),), trials=2), Results()
    for limit in (0, 1, 3, 2):
        results.run_all(settings, limit)
        document.write(tmp_path / "early.md", settings, results.lookup, [])


# --- what a run leaves


def test_the_error_is_taken_where_the_edit_is(tmp_path):
    path = tmp_path / "error.csv"
    head = "step,seconds,splats,psnr_truth,psnr_truth_inside,psnr_source_outside\n"
    path.write_text(f"{head}0,0.0,5,10,9,inf\n5,1.5,5,,,\n10,3.0,6,12,11.5,40\n")
    row = runner.read_table(path)
    assert (row["measure"], row["error"], row["seconds"]) == ("psnr_truth_inside", [9, 11.5], [0.0, 3.0])
    assert (row["step"], row["splats"], row["outside"]) == ([0, 10], [5, 6], 40.0)
    path.write_text("step,seconds,splats,psnr_edit,psnr_source\n0,0.0,5,10,inf\n")
    assert runner.read_table(path)["measure"] == "psnr_edit" and runner.read_table(path)["outside"] is None


def test_a_key_is_of_values_and_contents(tmp_path):
    splats, config = tmp_path / "a.ply", error_vs_time.ROOT / "configs" / "closed-form.yaml"
    splats.write_bytes(b"one")

    def key(*overrides: str) -> str:
        cell = cells.Cell("methods", "b", "c", "l", 0, str(config), (f"system.gs_source={splats}", *overrides))
        return runner.Runner(tmp_path / "none.jsonl", tmp_path).key(cell)

    first = key()
    assert key("system.guidance.guidance_scale=7.5") == first  # as the config has it
    assert key("system.guidance.guidance_scale=8") != first
    splats.write_bytes(b"two")
    assert key() != first
    json.dumps(runner.settings_of(cells.Cell("methods", "b", "c", "l", 0, str(config), ())))


@pytest.mark.parametrize("name", ["dc-ge-ip2p", "closed-form"])
def test_every_setting_of_every_run_is_known_to_its_system(name):
    path, place = (
        str(error_vs_time.ROOT / "configs" / f"{name}.yaml"),
        ("data.source=demo:statue", "system.gs_source=''"),
    )
    words = (*place, "system.prompt_processor.prompt=Make it sunset")
    values, families = error_vs_time.values_of(path, list(words)), tuple(cells.FAMILIES)
    scales = dict.fromkeys(families, 7.5) if name == "closed-form" else {}
    made = replace(bench(), config=path, values=values, families=families, overrides=place, scales=scales)
    order = Results().run_all(cells.Settings((made,), seeds=(0,), trials=0, ablations=not scales))
    for cell in {cell.label: cell for cell in order if cell.label in (*families, *cells.ABLATIONS)}.values():
        config = load_config(cell.config, cli_args=[*cell.overrides, *runner.QUIET])
        check(plugin.find("dreamcatalyst-data"), config.data, "data")
        guidance = check(plugin.find("dreamcatalyst-edit-system"), config.system, "system")["guidance"]
        parse(PRIORS.get(guidance.prior_type).Config, guidance.prior, "system.guidance.prior")
        assert chosen_schedule(guidance, chosen_rule(guidance)).limits[1] <= 0.98


# --- what is asked of priors


def test_every_edit_is_possible_in_its_world_and_methods_are_tuned_on_others():
    cases = (*error_vs_time.DEMO, *error_vs_time.DEMO_TUNING, *error_vs_time.CAPTURE_TUNING)
    for case in cases:
        name = case.overrides[0].removeprefix("data.source=demo:")
        world = make_world(name, views=1, size=8)
        assert find_edit(case.instruction) in possible(world), case
        assert name == "statue" or world.seed < HELD_OUT
    asked = {find_edit(case.instruction).name for case in error_vs_time.DEMO}
    assert not asked & {find_edit(case.instruction).name for case in error_vs_time.DEMO_TUNING}


def test_on_one_prior_every_rule_rests_at_the_edit():
    def config(family: str) -> GuidanceConfig:
        given = dict(setting.split("=") for setting in cells.FAMILIES[family].settings)
        return parse(GuidanceConfig, {**given, "max_step_percent": 0.5}, "system.guidance")

    prior = balance.common_prior(config("dreamcatalyst"))
    assert balance.balanced_scale(prior, config("dreamcatalyst")) == pytest.approx(7.5)
    for family in cells.FAMILIES:
        rule, schedule = chosen_rule(config(family)), chosen_schedule(config(family), chosen_rule(config(family)))
        scale = balance.balanced_scale(prior, config(family))
        if isinstance(rule, Rule):
            rest = fixed_point(prior, rule, schedule.rest(prior.alphas_cumprod), scale, 1.0)
            assert rest.rho == pytest.approx(1.0) and rest.drift == pytest.approx(0.0), family
        else:
            assert scale == 1.0
