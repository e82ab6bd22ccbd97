"""The table says what it means, and says so when it does not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from stable_baselines3.common.utils import LinearSchedule

from benchmarks import experiments
from benchmarks.experiments import Experiment, experiment, read_table, selected
from sb3_mpc_policy import hyperparams

ENV_ID = "CartPoleSoftWallsPyBullet-v0"
ROW: dict[str, Any] = {"env": ENV_ID, "steps": 2048, "seeds": [1000, 1001]}


def table(path: Path, text: str) -> list[Experiment]:
    (path / "table.yml").write_text(text)
    return read_table(path / "table.yml")


def row(**changes: Any) -> Experiment:
    return experiment("some/row", ROW | changes)


# -- what a row becomes --


def test_a_row_has_the_protocol_s_defaults() -> None:
    made = row()
    assert (made.algorithm, made.policy, made.n_envs, made.normalize) == ("PPO", "MpcLcsPolicy", 1, None)
    assert (made.evaluate, made.episodes, made.probes) == (((None, 128),), 50, ())


def test_settings_lie_over_the_tuned_ones_of_the_mpc_policy() -> None:
    settings = row(settings={"n_steps": 99, "policy_kwargs": {"horizon": 3}}).settings
    tuned = hyperparams(ENV_ID)
    assert settings["n_steps"] == 99 and settings["batch_size"] == tuned["batch_size"]
    assert settings["policy_kwargs"] == tuned["policy_kwargs"] | {"horizon": 3}


def test_other_policies_start_from_the_library_s_defaults() -> None:
    assert row(policy="MlpPolicy").settings == {"device": "cpu"}
    assert row(env="Pendulum-v1").settings == {"device": "cpu"}  # nothing tuned for it


def test_seeds_by_first_and_count() -> None:
    assert row(seeds={"first": 1000, "count": 3}).seeds == (1000, 1001, 1002)


def test_rewards_are_normalised_with_the_discount_of_the_algorithm() -> None:
    assert row(policy="MlpPolicy", normalize=True).normalize == {}
    assert row(policy="MlpPolicy", normalize=True, settings={"gamma": 0.9}).normalize == {"gamma": 0.9}
    given = {"norm_obs": False, "gamma": 0.5}
    assert row(policy="MlpPolicy", normalize=given, settings={"gamma": 0.9}).normalize == given


def test_numbers_in_the_notation_that_yaml_takes_for_text(tmp_path: Path) -> None:
    text = f"a: {{env: {ENV_ID}, seeds: [0], steps: 1e4, settings: {{learning_rate: 1e-3, policy_kwargs: {{x: 2e0}}}}}}"
    (made,) = table(tmp_path, text)
    assert made.steps == 10_000 and made.settings["learning_rate"] == 1e-3
    assert made.settings["policy_kwargs"]["x"] == 2.0


def test_words_become_what_algorithms_take() -> None:
    settings = {
        "learning_rate": "lin_1e-3", "train_freq": [1, "episode"], "policy_kwargs": {"activation_fn": "ReLU"}, "x": "y",
    }  # fmt: skip
    arguments = experiments.algorithm_arguments(settings)
    rate = arguments["learning_rate"]
    assert [rate(1.0), rate(0.5), rate(0.0)] == pytest.approx([1e-3, 5e-4, 0.0])
    assert arguments["train_freq"] == (1, "episode") and arguments["x"] == "y"
    assert arguments["policy_kwargs"]["activation_fn"] is torch.nn.ReLU
    assert settings["policy_kwargs"] == {"activation_fn": "ReLU"}


def test_an_activation_function_that_there_is_not() -> None:
    with pytest.raises(ValueError, match="activation_fn"):
        experiments.algorithm_arguments({"policy_kwargs": {"activation_fn": "Tahn"}})


# -- the hash --


def test_the_hash_is_that_of_equal_settings_however_they_are_written(tmp_path: Path) -> None:
    a, b, c = table(
        tmp_path,
        f"""
        .base: &base {{n_steps: 64, batch_size: 32}}
        a: {{env: {ENV_ID}, steps: 100, seeds: [1], policy: MlpPolicy, settings: *base}}
        b: {{seeds: [2], env: {ENV_ID}, policy: MlpPolicy, settings: {{batch_size: 32, n_steps: 64}}, steps: 1e2}}
        c: {{seeds: [2], env: {ENV_ID}, policy: MlpPolicy, steps: 100, settings: {{<<: *base, n_steps: 65}}}}
        """,
    )
    assert a.settings_hash == b.settings_hash != c.settings_hash
    assert len(a.settings_hash) == 12


@pytest.mark.parametrize(
    "change",
    [
        {"env": "CartPoleSoftWallsDrake-v0"}, {"steps": 2049}, {"episodes": 49}, {"n_envs": 2}, {"normalize": True},
        {"evaluate": [[128, 64], [None, 128]]}, {"settings": {"policy_kwargs": {"horizon": 5}}},
        {"settings": {"learning_rate": "lin_2e-2"}}, {"policy": "MlpPolicy"},
    ],
    ids=lambda change: next(iter(change)),
)  # fmt: skip
def test_whatever_determines_a_run_is_in_the_hash(change: dict[str, Any]) -> None:
    assert row(**change).settings_hash != row().settings_hash


def test_tuned_settings_are_in_the_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    before = row().settings_hash
    monkeypatch.setattr(experiments, "hyperparams", lambda env: {"learning_rate": LinearSchedule(1e-3, 0.0, 1.0)})
    changed = row().settings_hash
    monkeypatch.setattr(experiments, "hyperparams", lambda env: {"learning_rate": LinearSchedule(2e-3, 0.0, 1.0)})
    assert len({before, changed, row().settings_hash}) == 3


def test_seeds_and_probes_are_not_in_the_hash() -> None:
    assert row(seeds=[5], probes=["robustness"]).settings_hash == row().settings_hash


# -- in a hurry --


@pytest.mark.parametrize(
    ("changes", "steps"),
    [
        ({}, 256),
        ({"policy": "MlpPolicy", "steps": 100_000}, 2_048),
        ({"policy": "MlpPolicy", "algorithm": "SAC"}, 512),
        ({"policy": "MlpPolicy", "algorithm": "TQC", "steps": 100}, 100),
    ],
)
def test_small_is_one_short_run_scored_at_both_ends(changes: dict[str, Any], steps: int) -> None:
    small = row(**changes).small()
    assert (small.seeds, small.steps, small.episodes, small.evaluate) == ((1000,), steps, 4, ((None, steps),))


# -- which rows --


def test_patterns_choose_rows_in_the_order_of_the_table() -> None:
    rows = [experiment(name, ROW) for name in ("mpc/easy", "mlp/easy", "mpc/hard")]
    names = [each.name for each in selected(rows, ["mpc/h*", "*/easy"])]
    assert names == ["mpc/easy", "mlp/easy", "mpc/hard"]
    assert selected(rows, None) == rows
    with pytest.raises(ValueError, match=r"no row matches 'mcp/easy' \(close: .*mpc/easy"):
        selected(rows, ["mpc/*", "mcp/easy"])


# -- what is refused --


@pytest.mark.parametrize(
    ("text", "message"),
    [
        pytest.param("a: {}\nb: {}\na: {}", "line 3: 'a' stands twice", id="row twice"),
        pytest.param("a: {env: x, env: y}", "'env' stands twice", id="key twice"),
        pytest.param("a: [", "table.yml", id="no YAML"),
        pytest.param("- a", "must be a mapping", id="a list"),
        pytest.param("a: 3", "row 'a': must be a mapping", id="not a row"),
        pytest.param("A/b: {}", "row 'A/b'", id="capital letters"),
        pytest.param("a/../b: {}", "row 'a/../b'", id="out of the folder"),
        pytest.param("a.runs: {}", "row 'a.runs'", id="another row's file"),
    ],
)
def test_a_table_that_is_none(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError) as caught:
        table(tmp_path, text)
    assert message in str(caught.value) and "table.yml" in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("env", 3), ("env", ""), ("algorithm", "DQN"), ("algorithm", ["PPO"]), ("policy", None), ("settings", [1]),
        ("settings", {"seed": 3}), ("settings", {"learning_rate": "lin_fast"}), ("n_envs", 0), ("n_envs", True),
        ("normalize", "yes"), ("steps", -1), ("steps", 1.5), ("steps", "many"), ("seeds", []), ("seeds", 1000),
        ("seeds", [1, 1]), ("seeds", [1.5]), ("seeds", {"first": 1}), ("seeds", {"first": "a", "count": 2}),
        ("evaluate", 0), ("evaluate", [[100, 10]]), ("evaluate", [[100, 10], [50, 10], [None, 20]]),
        ("evaluate", [[None, 10], [None, 20]]), ("evaluate", "often"), ("evaluate", [10]), ("evaluate", []),
        ("episodes", 51), ("episodes", 0), ("probes", ["nonsense"]), ("probes", "robustness"),
    ],
)  # fmt: skip
def test_a_value_of_the_wrong_kind_is_told_with_row_and_key(key: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"row 'some/row', {key}: "):
        row(**{key: value})


def test_an_unknown_key_is_told_with_what_may_be_meant() -> None:
    with pytest.raises(ValueError, match=r"row 'some/row': unknown key 'step' \(close: steps"):
        row(step=3)


@pytest.mark.parametrize("key", ["env", "steps", "seeds"])
def test_what_has_no_default_is_needed(key: str) -> None:
    with pytest.raises(ValueError, match=f"row 'a': '{key}' is missing"):
        experiment("a", {name: value for name, value in ROW.items() if name != key})


def test_the_mpc_policy_is_for_ppo() -> None:
    with pytest.raises(ValueError, match=r"row 'some/row', policy: .* SAC"):
        row(algorithm="SAC")


def test_templates_are_no_rows_and_may_be_merged_and_overridden(tmp_path: Path) -> None:
    text = f"""
        .base: &base {{env: {ENV_ID}, steps: 64, seeds: [0]}}
        a: &a {{<<: *base, steps: 128}}
        b: {{<<: *a, steps: 256}}
        c: *base
        """
    assert [(each.name, each.steps) for each in table(tmp_path, text)] == [("a", 128), ("b", 256), ("c", 64)]
