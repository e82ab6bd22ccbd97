"""Verdicts, medians, ratios and aggregates, against numbers worked out by hand and by SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats

from benchmarks.aggregates import across_tasks, iqm, profile
from benchmarks.evaluation import Evaluation
from benchmarks.summary import Row, curve, ratio, spread, verdict


def run(*scores: float, every: int = 128) -> list[Evaluation]:
    """A run with these scores; a step takes 0.01 s, a rollout 64 steps."""
    return [Evaluation(every * i, every * i // 64, 0.01 * every * i, score) for i, score in enumerate(scores)]


def row(name: str, *runs: list[Evaluation]) -> Row:
    return Row(name, "Env-v0", 1_000.0, 900.0, dict(enumerate(runs, start=1000)))


# -- verdicts --


def test_a_run_is_solved_at_95_percent_and_held_above_90() -> None:
    judged = verdict(run(0.0, 949.0, 950.0, 900.0, 960.0), 1_000.0)
    assert judged == (4, 256, 2.56, True, 960.0, 900.0)
    assert not verdict(run(0.0, 950.0, 899.0), 1_000.0).held


def test_a_run_that_is_never_solved_has_no_time_to_solve() -> None:
    assert verdict(run(0.0, 949.0), 1_000.0) == (None, None, None, False, 949.0, None)


# -- medians and quartiles --


def test_quartiles_are_linear_between_neighbours() -> None:
    assert spread([4.0, 1.0, 3.0, 2.0]) == (1.75, 2.5, 3.25, 4.0)
    values = np.random.default_rng(0).normal(size=11)
    assert spread(list(values)) == pytest.approx([*np.quantile(values, [0.25, 0.5, 0.75]), values.max()])


def test_an_unsolved_run_counts_as_infinite() -> None:
    assert spread([2, None, 4, 3, 1]) == (2.0, 3.0, 4.0, math.inf)
    assert spread([1, 2, None, None]) == (1.75, math.inf, math.inf, math.inf)
    assert spread([None]) == (math.inf,) * 4


def test_nothing_has_no_median() -> None:
    with pytest.raises(ValueError, match="values"):
        spread([])


# -- ratios --


def test_the_ratio_is_to_the_baseline_with_the_smallest_median() -> None:
    ours = row("mpc", run(0, 990), run(0, 0, 990), run(0, 0, 0, 990))  # 128, 256 and 384 steps
    slow = row("slow", run(0, 0, 0, 990, every=2_048))  # 6,144
    fast = row("fast", run(0, 0, 990, every=2_048), run(0, 990, every=2_048), run(0, 0, every=2_048))  # 4,096
    assert ratio("steps", ours, [slow, fast]) == ("fast", 16.0, False)
    assert ratio("rollouts", ours, [slow, fast]) == ("fast", 16.0, False)
    assert ratio("seconds", ours, [slow, fast]) == ("fast", pytest.approx(16.0), False)


def test_baselines_that_are_not_solved_need_at_least_what_they_were_given() -> None:
    ours = row("mpc", run(0, 990))
    never = row("never", run(0, 0, 0, every=2_048), run(0, 0, 990, every=2_048), run(0, 0, 0, every=2_048))
    assert ratio("steps", ours, [never]) == ("never", 4_096 / 128, True)


def test_a_solved_baseline_is_better_than_an_unsolved_one_that_ended_early() -> None:
    short, solved = row("short", run(0, 0, every=256)), row("solved", run(0, 990, every=2_048))
    assert ratio("steps", row("mpc", run(0, 990)), [short, solved]) == ("solved", 16.0, False)


def test_there_is_no_ratio_without_a_solved_run_of_ours_or_a_baseline() -> None:
    assert ratio("steps", row("mpc", run(0, 0)), [row("slow", run(0, 990))]) is None
    assert ratio("steps", row("mpc", run(0, 990)), []) is None


# -- learning curves --


def test_a_curve_is_the_quartiles_over_seeds_up_to_where_the_first_ends() -> None:
    runs = [run(0, 100 * i, 200 * i) for i in (1, 2, 3)]
    times, quartiles = curve(row("mpc", *runs, run(0, 400)), "steps", 64.0)
    np.testing.assert_allclose(times, [64, 128])
    np.testing.assert_allclose(quartiles, [[0, 175], [0, 250], [0, 325]])


def test_between_evaluations_a_curve_is_linear_in_the_logarithm_of_time() -> None:
    often, rarely = run(0, 0, 0, every=128), run(0, 0, every=512)
    rarely[-1] = rarely[-1]._replace(score=300.0)
    times, (_, median, _) = curve(row("mpc", often, rarely, rarely), "steps", 64.0)
    np.testing.assert_allclose(times, [64, 128, 256])
    np.testing.assert_allclose(median, [0, 100, 200])  # one and two of the three doublings from 64 to 512


def test_of_several_evaluations_in_one_rollout_the_last_counts() -> None:
    evaluations = [Evaluation(0, 0, 0.0, 0.0), Evaluation(128, 2, 1.0, 10.0), Evaluation(256, 2, 2.0, 20.0)]
    times, quartiles = curve(row("mpc", evaluations), "rollouts", 0.5)
    np.testing.assert_allclose(times, [0.5, 2.0])
    np.testing.assert_allclose(quartiles[1], [0.0, 20.0])


# -- across tasks --


def test_tasks_are_compared_on_the_seeds_that_all_of_them_have() -> None:
    one, two = row("a", run(0, 500), run(0, 600), run(0, 700)), row("b", run(0, 900), run(0, 1_000))
    np.testing.assert_allclose(across_tasks([one, two]), [[0.5, 0.9], [0.6, 1.0]])
    assert across_tasks([one, None]) is None and across_tasks([]) is None


def test_the_interquartile_mean_is_scipys_trimmed_mean_inside_its_interval() -> None:
    scores = {name: np.random.default_rng(seed).normal(size=(7, 3)) for seed, name in enumerate("ab")}
    for name, (value, low, high) in iqm(scores, reps=200).items():
        assert value == pytest.approx(scipy.stats.trim_mean(scores[name], 0.25, axis=None))
        assert low < value < high


def test_intervals_are_the_same_at_every_call_and_leave_random_numbers_alone() -> None:
    scores = {"a": np.random.default_rng(0).normal(size=(5, 2))}
    np.random.seed(7)  # noqa: NPY002
    first = iqm(scores, reps=100)
    untouched = np.random.rand()  # noqa: NPY002
    assert iqm(scores, reps=100) == first
    np.random.seed(7)  # noqa: NPY002
    assert np.random.rand() == untouched  # noqa: NPY002


def test_a_profile_is_the_share_of_runs_above_each_threshold() -> None:
    scores = {"a": np.array([[0.1, 0.5], [0.7, 0.9]])}
    shares, (low, high) = profile(scores, np.array([0.0, 0.5, 0.8, 1.0]), reps=50)["a"]
    np.testing.assert_allclose(shares, [1.0, 0.5, 0.25, 0.0])
    assert (low <= shares).all() and (shares <= high).all()
