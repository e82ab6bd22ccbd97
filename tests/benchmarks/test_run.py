"""What is missing is run, what is done is kept, and what goes wrong is told: over stops, crashes and changes."""

from __future__ import annotations

import io
import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from benchmarks import evaluation, execution, probes, run, training
from benchmarks.execution import Executor, Outcome, Task
from benchmarks.experiments import experiment
from benchmarks.progress import Costs, ProgressBar, duration, guess
from benchmarks.run import Benchmark
from benchmarks.store import Store

ENV_ID = "CartPoleSoftWallsPyBullet-v0"
ROW: dict[str, Any] = {
    "env": ENV_ID, "policy": "MlpPolicy", "settings": {"n_steps": 32, "batch_size": 32}, "steps": 64, "evaluate": 32,
    "seeds": [0, 1], "episodes": 1,
}  # fmt: skip

OFF_POLICY = {"learning_starts": 40, "policy_kwargs": {"net_arch": [16]}}

ODD_ENVIRONMENTS = """
import os, time
import gymnasium as gym
import numpy as np

class Odd(gym.Env):
    observation_space = action_space = gym.spaces.Box(-1.0, 1.0, (1,))
    steps = 0

    def __init__(self, what):
        self.what = what

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.scored = seed is not None and seed >= 1_000_000
        return self.observation_space.sample() * 0.0, {}

    def step(self, action):
        self.steps += 1
        if self.what == "slow":
            time.sleep(0.01)
        if self.steps > 20:
            if self.what == "raises":
                raise RuntimeError("the gripper came off")
            if self.what == "dies":
                os._exit(3)
        reward = np.nan if self.what == "nan" and self.scored and self.steps > 15 else float(action[0])
        return np.zeros(1, np.float32), reward, False, False, {}

for what in ("slow", "raises", "dies", "nan", "fine"):
    gym.register(f"{what.title()}-v0", Odd, max_episode_steps=10, kwargs={"what": what})
"""


class Here(Executor):
    """Runs tasks in this process."""

    def __init__(self) -> None:
        super().__init__(execution.loky(1))
        self.done: list[str] = []

    def outcomes(self, tasks: Sequence[Task]):
        for task in tasks:
            self.done.append(task.name)
            _, result = execution._attempt(task)
            failed = isinstance(result, execution.Failure)
            yield Outcome(task, None if failed else result, result if failed else None)


def benchmark(folder: Path) -> Benchmark:
    return Benchmark(Store(folder / "results"), folder / "scratch", Here(), Console(file=io.StringIO()))


def names(benchmark: Benchmark, *rows: Any) -> list[str]:
    return [m.name for of_row in benchmark.missing_of(rows).values() for m in of_row]


def run_missing(benchmark: Benchmark, *rows: Any) -> list[str]:
    """Run what is missing of the rows; what was run."""
    benchmark.executor.done.clear()
    benchmark.run([m for of_row in benchmark.missing_of(rows).values() for m in of_row])
    return benchmark.executor.done


def table(path: Path, rows: dict[str, dict[str, Any]]) -> Path:
    """A table in which values are written as JSON, which is YAML."""
    (path / "table.yml").write_text(json.dumps(rows))
    return path / "table.yml"


def command(folder: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "benchmarks.run", "--table", str(folder / "table.yml"), "--results",
            str(folder / "results"), "--scratch", str(folder / "scratch"), *arguments]  # fmt: skip


def surroundings(folder: Path) -> dict[str, str]:
    """For a process that can import the odd environments."""
    (folder / "odd.py").write_text(ODD_ENVIRONMENTS)
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}


def odd(what: str, **changes: Any) -> dict[str, Any]:
    return ROW | {"env": f"odd:{what.title()}-v0", "seeds": [0], "evaluate": 16} | changes


# -- one run --


@pytest.mark.parametrize(
    ("changes", "steps"),
    [
        pytest.param({}, [0, 32, 64], id="PPO"),
        pytest.param({"n_envs": 2, "normalize": True, "settings": {"n_steps": 16, "batch_size": 32}}, [0, 32, 64],
                     id="normalised"),
        pytest.param({"policy": "MpcLcsPolicy", "evaluate": [[32, 32], [None, 64]], "steps": 96,
                      "settings": {"n_steps": 32, "policy_kwargs": {"horizon": 5}}}, [0, 32, 96], id="MPC"),
        pytest.param({"algorithm": "SAC", "settings": OFF_POLICY}, [0, 32, 64], id="SAC"),
        pytest.param({"algorithm": "TQC", "settings": OFF_POLICY, "normalize": True}, [0, 32, 64], id="TQC"),
        pytest.param({"algorithm": "CrossQ", "settings": OFF_POLICY}, [0, 32, 64], id="CrossQ"),
    ],
)  # fmt: skip
def test_a_run_is_evaluated_and_saved_whatever_the_algorithm(changes: dict[str, Any], steps: list[int]) -> None:
    if changes.get("algorithm") in ("TQC", "CrossQ"):
        pytest.importorskip("sb3_contrib")
    row = experiment("a", ROW | changes)
    trained, again = training.train(row, 3), training.train(row, 3)
    assert [e.steps for e in trained.evaluations] == steps
    assert [e[:2] + e[3:] for e in trained.evaluations] == [e[:2] + e[3:] for e in again.evaluations]
    assert training.train(row, 4).evaluations[-1].score != trained.evaluations[-1].score

    # the model that was saved scores what the last evaluation said
    with training._environment(row, 0) as env:
        saved = trained.model
        model = training.algorithm(row.algorithm).load(io.BytesIO(saved.model), training._normalized(env, saved))
        assert evaluation.score(model, ENV_ID, 1) == pytest.approx(trained.evaluations[-1].score, rel=1e-5)


def test_machine_and_versions_are_noted_without_a_name() -> None:
    assert f"python={platform.python_version()} torch=" in training.versions()
    assert platform.node() not in training.machine() and "cores" in training.machine()


# -- what is missing --


def test_only_what_is_missing_is_run(tmp_path: Path) -> None:
    first, second = experiment("a", ROW), experiment("b/c", ROW | {"steps": 32, "seeds": [0]})
    found = benchmark(tmp_path)
    assert names(found, first, second) == ["a, seed 0", "a, seed 1", "b/c, seed 0"]
    assert run_missing(found, second) == [f"oracle and LQR in {ENV_ID}, 1 episodes", "b/c, seed 0"]
    assert run_missing(found, first, second) == ["a, seed 0", "a, seed 1"]
    assert run_missing(found, first, second) == [] and not found.failures
    assert [e.steps for e in found.store.evaluations("a")[1]] == [0, 32, 64]

    # measured against the oracle, as it scores by itself
    line = found.store.runs("b/c")[0]
    assert line.settings == second.settings_hash and line.env == ENV_ID
    reference = training.reference(ENV_ID, 1)
    assert (line.oracle, line.lqr) == (reference.oracle, reference.lqr)


def test_changed_settings_are_run_again_and_more_seeds_are_added(tmp_path: Path) -> None:
    found = benchmark(tmp_path)
    run_missing(found, experiment("a", ROW | {"seeds": [0]}))
    assert run_missing(found, experiment("a", ROW)) == ["a, seed 1"]
    changed = experiment("a", ROW | {"steps": 32, "seeds": [1]})
    assert run_missing(found, changed) == ["a, seed 1"]
    assert {seed: [e.steps for e in es] for seed, es in found.store.evaluations("a").items()} == {
        0: [0, 32, 64], 1: [0, 32],
    }  # fmt: skip


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What two probes are asked; "reuse" fails."""
    calls: list[Any] = []

    def probe(model: Any, env_id: str, *, small: bool) -> list[dict[str, Any]]:
        normalization = model.get_vec_normalize_env()
        calls.append((env_id, small, normalization and round(normalization.obs_rms.count)))
        return [
            {
                "of": "weights",
                "quantity": "sum",
                "value": float(sum(p.detach().sum() for p in model.policy.parameters())),
            }
        ]

    def failing(model: Any, env_id: str, *, small: bool) -> list[dict[str, Any]]:
        raise ArithmeticError("no such number")

    monkeypatch.setitem(sys.modules, "stub_probes", type("Stub", (), {"probe": probe, "failing": failing}))
    monkeypatch.setitem(probes.PROBES, "robustness", "stub_probes:probe")
    monkeypatch.setitem(probes.PROBES, "reuse", "stub_probes:failing")
    return calls


def test_a_probe_added_later_needs_no_training(tmp_path: Path, asked: list[Any]) -> None:
    found = benchmark(tmp_path)
    row = ROW | {"normalize": True, "seeds": [0]}
    run_missing(found, experiment("a", row))
    before = found.store.runs("a")
    (missing,) = found.missing(experiment("a", row | {"probes": ["robustness"]}))
    assert missing.model is not None and missing.probes == ("robustness",)
    run_missing(found, experiment("a", row | {"probes": ["robustness"]}))
    assert asked == [(ENV_ID, False, 65)]  # observations of 64 steps and a reset
    assert found.store.runs("a") == before

    # what it finds is what it finds right after training
    together = benchmark(tmp_path / "together")
    run_missing(together, experiment("a", row | {"probes": ["robustness"]}))
    (line,) = found.store.probe("a", "robustness")
    assert together.store.probe("a", "robustness") == [line] and line["of"] == "weights"


def test_without_the_saved_model_a_probe_needs_training(tmp_path: Path, asked: list[Any]) -> None:
    found = benchmark(tmp_path)
    run_missing(found, experiment("a", ROW | {"seeds": [0]}))
    (tmp_path / "scratch/models/a/0/settings").write_text("others")
    (missing,) = found.missing(experiment("a", ROW | {"seeds": [0], "probes": ["robustness"]}))
    assert missing.model is None


def test_a_probe_that_fails_is_told_and_the_run_and_other_probes_are_kept(tmp_path: Path, asked: list[Any]) -> None:
    found = benchmark(tmp_path)
    row = experiment("a", ROW | {"seeds": [0], "probes": ["reuse", "robustness"]})
    run_missing(found, row)
    assert list(found.failures) == ["a, seed 0, probe reuse"]
    assert found.failures["a, seed 0, probe reuse"].reason == "ArithmeticError: no such number"
    assert list(found.store.runs("a")) == [0] and found.store.probe("a", "robustness")
    assert [m.probes for m in found.missing(row)] == [("reuse",)]


def test_a_row_whose_file_is_damaged_is_left_alone(tmp_path: Path) -> None:
    found = benchmark(tmp_path)
    rows = [experiment(name, ROW | {"seeds": [0]}) for name in ("a", "b")]
    run_missing(found, *rows)
    path = tmp_path / "results" / "a.csv"
    path.write_text("seed,steps\n0,12")
    rows = [experiment(name, ROW) for name in ("a", "b")]
    assert run_missing(found, *rows) == ["b, seed 1"]
    assert "a.csv" in found.failures["a"].reason
    assert path.read_text() == "seed,steps\n0,12"


# -- the command --


def test_what_goes_wrong_in_one_run_is_told_and_the_others_are_done(tmp_path: Path) -> None:
    rows = {what: odd(what) for what in ("raises", "dies", "nan", "fine")}
    rows["unknown"] = odd("unknown")
    rows["uninstalled"] = ROW | {"env": "no_such_package:Env-v0", "seeds": [0]}
    table(tmp_path, rows | {"more": odd("fine", seeds=[0, 1, 2])})
    done = subprocess.run(
        command(tmp_path, "--jobs", "2"), env=surroundings(tmp_path), capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done.stderr
    for told in (
        "failed: raises, seed 0: RuntimeError: the gripper came off",
        "failed: dies, seed 0: its worker process died",
        "failed: nan, seed 0: FloatingPointError: the score after",
        "failed: unknown, seed 0: NameNotFound",
        "failed: uninstalled, seed 0: ModuleNotFoundError",
    ):
        assert told in done.stderr
    store = Store(tmp_path / "results")
    assert {name: list(store.runs(name)) for name in (*rows, "more")} == {
        "raises": [], "dies": [], "nan": [], "fine": [0], "unknown": [], "uninstalled": [], "more": [0, 1, 2],
    }  # fmt: skip
    assert not (tmp_path / "results" / "raises.csv").exists()
    assert "RuntimeError" in (tmp_path / "scratch/failures/raises-seed-0.txt").read_text()


@pytest.mark.parametrize("kind", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_stopped_benchmark_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: signal.Signals
) -> None:
    """Stopped while a later run is under way, it keeps the first; what is there in the end is as if never stopped."""
    row = odd("slow", seeds=[0, 1, 2])
    table(tmp_path, {"a": row})
    environment, marker = surroundings(tmp_path), tmp_path / "results" / "a.runs.csv"
    begun = subprocess.Popen(
        command(tmp_path), env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )
    wait_until(lambda: marker.exists() or begun.poll() is not None)
    if kind == signal.SIGINT:
        os.killpg(begun.pid, kind)  # a terminal's Ctrl-C reaches the workers too
    else:
        begun.kill()
    _, said = begun.communicate(timeout=60)
    assert begun.returncode == (run.INTERRUPTED if kind == signal.SIGINT else -kind)
    assert b"Traceback" not in said
    first = marker.read_text()
    kept = list(Store(tmp_path / "results").runs("a"))
    assert 1 <= len(kept) < 3

    monkeypatch.syspath_prepend(tmp_path)
    again, never_stopped = benchmark(tmp_path), benchmark(tmp_path / "never_stopped")
    made = run_missing(again, experiment("a", row))
    assert made == [f"a, seed {seed}" for seed in row["seeds"] if seed not in kept]
    assert set(first.splitlines()) <= set(marker.read_text().splitlines())
    run_missing(never_stopped, experiment("a", row))
    assert scores(again.store) == scores(never_stopped.store)
    monkeypatch.delitem(sys.modules, "odd")


def scores(store: Store) -> dict[int, list[float]]:
    """Of the row "a", by seed."""
    return {seed: [e.score for e in evaluations] for seed, evaluations in store.evaluations("a").items()}


def wait_until(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


@pytest.mark.slow
def test_runs_on_a_ray_cluster_score_the_same(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    table(tmp_path, {"a": ROW})
    found = []
    for name, arguments in (("here", []), ("ray", ["--executor", "ray"])):
        whole = [*command(tmp_path, "--jobs", "2", *arguments), "--results", str(tmp_path / name)]
        subprocess.run(whole, env=surroundings(tmp_path), check=True, capture_output=True)
        found.append(scores(Store(tmp_path / name)))
    assert found[0] == found[1] and list(found[0]) == [0, 1]


def test_small_goes_into_the_scratch_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "Executor", lambda backend, on_message: Here())
    path = table(tmp_path, {"a": ROW | {"episodes": 9, "evaluate": 8}})
    assert run.main(["--table", str(path), "--small", "--scratch", str(tmp_path / "scratch")]) == 0
    found = Store(tmp_path / "scratch/small").evaluations("a")
    assert {seed: [e.steps for e in evaluations] for seed, evaluations in found.items()} == {0: [0, 64]}
    assert (tmp_path / "scratch/small/models/a/0/model.zip").exists()


def test_changes_and_seeds_from_the_command_line(tmp_path: Path) -> None:
    path = table(tmp_path, {"a": ROW, "b": ROW})
    args = run.arguments(
        f"--table {path} --only a --seeds 7 8 --set steps=32 settings.learning_rate=1e-4 --results {tmp_path}".split()
    )
    (row,) = run.chosen(args)
    assert (row.name, row.seeds, row.steps) == ("a", (7, 8), 32)
    assert row.settings == {"device": "cpu", **ROW["settings"], "learning_rate": 1e-4}


def test_the_list_tells_what_is_missing_and_runs_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = {"a": ROW, "b/c": ROW | {"seeds": {"first": 0, "count": 10}}}
    table(tmp_path, rows)
    run_missing(benchmark(tmp_path), experiment("a", ROW | {"seeds": [1]}))
    assert run.main([*command(tmp_path)[3:], "--list"]) == 0
    lines = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if line.strip()}
    assert lines["a"][-3:] == ["1", "1", "-"] and lines["b/c"][-3:] == ["-", "10", "-"]
    assert list(Store(tmp_path / "results").runs("a")) == [1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--only nothing", "no row matches 'nothing'"),
        ("--table /no/such/table.yml", "/no/such/table.yml"),
        ("--seeds 1 1", "different seeds"),
        ("--set nothing", "name=value"),
        ("--set colour=red", "unknown key 'colour'"),
        ("--jobs 0", "--jobs"),
        ("--address here", "--address"),
    ],
)
def test_bad_arguments(tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: str, message: str) -> None:
    table(tmp_path, {"a": ROW})
    try:
        status: object = run.main([*command(tmp_path)[3:], *arguments.split()])
    except SystemExit as error:
        status = error.code
    assert status == 2 and message in capsys.readouterr().err


def test_changed_settings_do_not_go_where_the_table_s_results_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run.arguments(["--set", "steps=3"])
    assert "--results" in capsys.readouterr().err


def test_commit_is_the_repository_s() -> None:
    head = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False,
                          cwd=Path(run.__file__).parent).stdout.strip()  # fmt: skip
    assert head.startswith(run.commit().rstrip("+"))
    assert bool(run.commit()) == bool(head)


# -- how long it takes --


def test_known_rows_cost_what_they_took_and_correct_the_guess_for_others() -> None:
    costs, known, other = Costs(), experiment("a", ROW), experiment("b", ROW | {"steps": 6400})
    assert costs.of(other) == guess(other) > guess(known)
    for seconds in (2.0, 4.0):
        costs.finished(known, seconds)
    assert costs.of(known) == 3.0
    assert costs.of(other) == pytest.approx(guess(other) * 3.0 / guess(known))


def test_the_guess_counts_evaluations_of_each_phase() -> None:
    def evaluations(evaluate: Any) -> float:
        row = {"evaluate": evaluate, "steps": 1000, "policy": "MlpPolicy"}
        more, less = (guess(experiment("a", ROW | row | {"episodes": n})) for n in (2, 1))
        return (more - less) / (guess(experiment("a", ROW | row | {"episodes": 3})) - more) and (more - less)

    per_evaluation = evaluations(1000) / 2  # first and last
    assert evaluations(100) == pytest.approx(11 * per_evaluation)
    assert evaluations([[200, 20], [None, 400]]) == pytest.approx((1 + 10 + 2) * per_evaluation)


def test_the_time_left_is_shared_among_the_workers_and_at_least_the_longest() -> None:
    console = Console(file=io.StringIO())
    expected = {name: (lambda s=seconds: s) for name, seconds in {"a": 100.0, "b": 60.0, "c": 60.0, "d": 500.0}.items()}
    under_way: dict[str, float] = {}
    bar = ProgressBar(console, "x", expected, under_way, jobs=2)
    assert bar.seconds_left() == 500.0
    bar.advance("d")
    assert bar.seconds_left() == pytest.approx(110.0)
    under_way["a"] = time.monotonic() - 40.0
    assert bar.seconds_left() == pytest.approx(90.0, abs=1.0)


def test_durations_in_words() -> None:
    assert [duration(s) for s in (4.2, 100, 3_600, 7_510)] == ["4 s", "2 min", "1 h 00 min", "2 h 05 min"]
