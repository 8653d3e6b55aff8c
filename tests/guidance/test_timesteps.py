"""Timestep policies: every run covers its whole schedule, whatever its length."""

from __future__ import annotations

import math
from collections import Counter

import pytest
import torch
from dreamcatalyst.diffusion.noise import stable_diffusion_schedule
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.guidance.rules import RULES, get_rule, noise_level
from dreamcatalyst.guidance.timesteps import POLICIES, Schedule

ABAR = stable_diffusion_schedule()
FALLING = ["decreasing", "decreasing-full", "non-increasing"]
LENGTHS = [2, 3, 7, 20, 350, 351, 352, 701, 1000, 1200, 1500, 3000]


def run(policy, steps, **options):
    return [Schedule(policy, **options).timestep(step, steps, ABAR) for step in range(steps)]


def test_a_schedule_of_its_own_length_is_cut_by_a_shorter_run():
    """As published: i = floor(350 (K - k) / K + 100) of 500 with K = 1500 also where 1200 steps are run."""
    schedule = Schedule("decreasing", 0.2, 0.9, steps=1500)
    for k in (0, 1, 600, 1199):
        published = 2 * math.floor(350 * (1500 - k) / 1500 + 100) + 1
        assert abs(schedule.timestep(k, 1200, ABAR) - published) <= 2  # ours ends at 0.2 with its last step
    assert schedule.timestep(1199, 1200, ABAR) > 340 and schedule.timestep(1499, 1500, ABAR) == 201
    assert schedule.timestep(4000, 5000, ABAR) == 201  # where the published index turns negative
    with pytest.raises(ConfigError, match="schedule_steps: got 0"):
        Schedule(steps=0)


@pytest.mark.parametrize("steps", LENGTHS)
def test_decreasing_goes_from_901_to_201(steps):
    taken = run("decreasing", steps)
    assert taken[0] == 901 and taken[-1] == 201
    assert noise_level(taken[0], 1000) == 0.9 and noise_level(taken[-1], 1000) == 0.2


def test_decreasing_ends_at_its_end_for_any_number_of_steps():
    for steps in range(1, 4000):
        assert Schedule().timestep(steps - 1, steps, ABAR) == 201


def test_decreasing_takes_every_ddim_step_evenly():
    """The code's floor(350 (1 - progress) + 100), in whole numbers: no step is lost to rounding."""
    for steps in LENGTHS:
        exact = [2 * (100 + 350 * (steps - 1 - k) // (steps - 1)) + 1 for k in range(steps)]
        assert run("decreasing", steps) == exact
    counts = Counter(run("decreasing", 3501))
    assert len(counts) == 351 and set(counts.values()) == {1, 10}  # one at 901, ten at every other


@pytest.mark.parametrize("policy", FALLING)
@pytest.mark.parametrize("steps", LENGTHS)
def test_falling_policies_fall(policy, steps):
    taken = run(policy, steps)
    assert all(a >= b for a, b in zip(taken, taken[1:], strict=False))
    assert all(type(t) is int and 0 <= t < 1000 for t in taken)


@pytest.mark.parametrize("policy", FALLING)
def test_longer_runs_take_the_same_way(policy):
    """Step k of a run is step 3k of a run three times as long (both have their last step at their end)."""
    short, long = run(policy, 401), run(policy, 1201)
    assert short == long[::3]


def test_decreasing_as_in_the_text_covers_all():
    assert run("decreasing-full", 1000) == list(range(999, -1, -1))
    assert run("decreasing-full", 2)[:] == [999, 0]


@pytest.mark.parametrize("policy", ["decreasing", "non-increasing", "uniform"])
def test_limits_are_kept(policy):
    taken = run(policy, 300, lowest=0.3, highest=0.6)
    assert min(taken) >= 301 and max(taken) <= 601
    if policy != "uniform":
        assert taken[-1] == 301 and taken[0] == 601


def test_uniform_is_uniform_over_the_published_indices():
    schedule = Schedule("uniform", seed=3)
    options = schedule.options(0.4, ABAR)
    assert list(options) == [2 * i + 1 for i in range(10, 490)]
    counts = Counter(schedule.timestep(step, 4800, ABAR) for step in range(4800))
    assert set(counts) <= set(options)
    chi_square = sum((counts[t] - 10) ** 2 / 10 for t in options)
    assert abs(chi_square - 479) < 5 * math.sqrt(2 * 479)


def test_uniform_depends_on_seed_and_step_alone():
    first = [Schedule("uniform", seed=0).timestep(step, 100, ABAR) for step in range(100)]
    torch.randn(10)
    assert first == [Schedule("uniform", seed=0).timestep(step, 500, ABAR) for step in range(100)]
    assert first != [Schedule("uniform", seed=1).timestep(step, 100, ABAR) for step in range(100)]


def test_non_increasing_spends_time_by_weight():
    """DreamTime: the share of steps above t is the share of W above t."""
    steps = 200_001
    schedule = Schedule("non-increasing", 0.02, 0.98)
    t = torch.arange(1000, dtype=torch.float64)
    weight = ((1 - ABAR) / ABAR).sqrt() * torch.exp(-((t - 500) ** 2) / (2 * 125**2))
    weight[:21] = weight[982:] = 0
    for progress in (0.1, 0.3, 0.5, 0.8, 0.99):
        taken = schedule.timestep(round(progress * (steps - 1)), steps, ABAR)
        assert weight[taken + 1 :].sum() / weight.sum() <= progress <= weight[taken:].sum() / weight.sum()


@pytest.mark.parametrize("policy", POLICIES.names())
@pytest.mark.parametrize("total", [50, 250, 1000, 4000])
def test_priors_of_another_length(policy, total):
    abar = stable_diffusion_schedule(total)
    schedule = Schedule(policy)
    taken = [schedule.timestep(step, 97, abar) for step in range(97)]
    assert all(0 <= t < total for t in taken)
    if policy == "decreasing":
        assert abs(taken[0] - 0.9 * total) < 2 and abs(taken[-1] - 0.2 * total) < 2


@pytest.mark.parametrize("name", RULES.names())
def test_rules_name_a_policy(name):
    assert get_rule(name).timesteps in POLICIES.names()


def test_where_a_run_comes_to_rest():
    assert list(Schedule("decreasing").rest(ABAR)) == [201]
    assert len(Schedule("uniform").rest(ABAR)) == 480


def test_one_step_is_the_last():
    assert Schedule("decreasing").timestep(0, 1, ABAR) == 201


def test_wrong_limits_and_names():
    with pytest.raises(ConfigError, match="min"):
        Schedule("decreasing", lowest=0.9, highest=0.2)
    with pytest.raises(ConfigError, match="Did you mean 'decreasing'"):
        Schedule("decreesing")
