"""Results read back as they were written, and a run counts when all of it is there."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks import store as store_module
from benchmarks.evaluation import Evaluation
from benchmarks.store import FinishedRun, Reference, ResultFileError, Store

ROW = "mpc/easy"
FOUND = [{"change": "mass", "amount": 0.7, "quantity": "score", "value": 1.5}]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "runs")


def finished(seed: int, settings: str = "abc") -> FinishedRun:
    return FinishedRun(
        seed, "Env-v0", settings, 5000.5, math.nan, 12.25, "0123abc+", "A processor, 2 cores", "python=3.11", "2026"
    )


def evaluations(*scores: float) -> list[Evaluation]:
    return [Evaluation(128 * i, 3 * i, 0.25 * i, score) for i, score in enumerate(scores)]


def test_runs_read_back_as_they_were_written(store: Store) -> None:
    store.add_run(ROW, finished(1001), evaluations(-12_345.5, 4.125))
    store.add_run(ROW, finished(1000), evaluations(1.0, 2.0, 3.0))
    assert store.evaluations(ROW) == {1000: evaluations(1.0, 2.0, 3.0), 1001: evaluations(-12_345.5, 4.125)}
    runs = store.runs(ROW)
    assert list(runs) == [1000, 1001]
    assert runs[1001]._replace(lqr=0.0) == finished(1001)._replace(lqr=0.0) and math.isnan(runs[1001].lqr)


def test_the_files_are_as_promised(store: Store) -> None:
    store.add_run(ROW, finished(7), evaluations(1.0, 2.0))
    store.add_probe(ROW, 7, "robustness", FOUND)
    files = {file.name: file.read_text().splitlines() for file in store.folder.iterdir()}
    assert set(files) == {"mpc__easy.csv", "mpc__easy.runs.csv", "mpc__easy.robustness.csv"}
    assert files["mpc__easy.csv"] == ["seed,steps,rollouts,seconds,score", "7,0,0,0.0,1.0", "7,128,3,0.25,2.0"]
    assert files["mpc__easy.runs.csv"][0] == ("seed,env,settings,oracle,lqr,wall_seconds,commit,machine,versions,date")
    assert files["mpc__easy.robustness.csv"] == ["seed,change,amount,quantity,value", "7,mass,0.7,score,1.5"]


def test_there_is_nothing_before_the_first_run(store: Store) -> None:
    assert store.runs(ROW) == {} and store.evaluations(ROW) == {} and store.probe(ROW, "reuse") == []
    assert store.references() == {}
    assert not store.folder.exists()


def test_a_run_made_again_replaces_the_old_one_and_what_was_probed_in_it(store: Store) -> None:
    for seed in (0, 1):
        store.add_run(ROW, finished(seed), evaluations(1.0, 2.0))
        store.add_probe(ROW, seed, "robustness", FOUND)
    store.add_run(ROW, finished(0, "new"), evaluations(5.0))
    assert store.evaluations(ROW) == {0: evaluations(5.0), 1: evaluations(1.0, 2.0)}
    assert {seed: run.settings for seed, run in store.runs(ROW).items()} == {0: "new", 1: "abc"}
    assert store.probe(ROW, "robustness") == [{"seed": 1, **FOUND[0]}]


@pytest.mark.parametrize("writes", range(5))
def test_a_run_that_is_half_written_is_no_run(store: Store, monkeypatch: pytest.MonkeyPatch, writes: int) -> None:
    """After any number of the files: what is read is the other run, with this one all old, all new, or not there."""
    for seed in (0, 1):
        store.add_run(ROW, finished(seed), evaluations(1.0, 2.0))
        store.add_probe(ROW, seed, "robustness", FOUND)
    left, write = iter(range(writes)), store_module._write_table

    def dying(*arguments) -> None:
        if next(left, None) is None:
            raise SystemExit
        write(*arguments)

    monkeypatch.setattr(store_module, "_write_table", dying)
    try:
        store.add_run(ROW, finished(0, "new"), evaluations(5.0))
    except SystemExit:
        assert writes < 4
    old, new = evaluations(1.0, 2.0), evaluations(5.0)
    assert store.evaluations(ROW)[1] == old
    settings = store.runs(ROW)[0].settings if 0 in store.runs(ROW) else None
    assert store.evaluations(ROW).get(0) == {"abc": old, None: None, "new": new}[settings]
    probed = {line["seed"] for line in store.probe(ROW, "robustness")}
    assert probed == ({0, 1} if settings == "abc" else {1})


def test_a_file_that_is_written_is_there_as_a_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), store_module.replaced(path) as temporary:
        temporary.write_text("ne")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    with store_module.replaced(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert [file.name for file in tmp_path.iterdir()] == ["a.csv"]


# -- probes and references --


def test_probes_of_several_seeds_with_several_keys(store: Store) -> None:
    for seed in (1, 0):
        store.add_run(ROW, finished(seed), evaluations(1.0))
    store.add_probe(ROW, 1, "robustness", FOUND)
    store.add_probe(ROW, 0, "robustness", [*FOUND, {"wall": "left", "quantity": "error", "value": 1 / 3}])
    assert store.probe(ROW, "robustness") == [
        {"seed": 0, "change": "mass", "amount": 0.7, "wall": "", "quantity": "score", "value": 1.5},
        {"seed": 0, "change": "", "amount": "", "wall": "left", "quantity": "error", "value": 0.333333},
        {"seed": 1, "change": "mass", "amount": 0.7, "wall": "", "quantity": "score", "value": 1.5},
    ]
    store.add_probe(ROW, 0, "robustness", FOUND)
    assert [line["seed"] for line in store.probe(ROW, "robustness")] == [0, 1]


@pytest.mark.parametrize("found", [[], [{"quantity": "score"}], [{"value": 1.0}]])
def test_a_probe_without_an_answer_is_refused(store: Store, found: list) -> None:
    store.add_run(ROW, finished(0), evaluations(1.0))
    with pytest.raises(ValueError, match="mpc/easy, seed 0: probe 'reuse'"):
        store.add_probe(ROW, 0, "reuse", found)


def test_references_by_environment_and_episodes(store: Store) -> None:
    for reference in (
        Reference("A", 4, 5.0, 4.0, "x"),
        Reference("A", 50, 5.5, 4.5, "x"),
        Reference("A", 4, 6, 3, "y"),
    ):
        store.add_reference(reference)
    assert store.references() == {("A", 4): Reference("A", 4, 6, 3, "y"), ("A", 50): Reference("A", 50, 5.5, 4.5, "x")}


# -- what is refused --


@pytest.mark.parametrize("score", [math.nan, math.inf])
def test_a_score_that_is_not_a_number_is_refused_and_nothing_stored(store: Store, score: float) -> None:
    with pytest.raises(ValueError, match="mpc/easy, seed 3: the score after 128 steps"):
        store.add_run(ROW, finished(3), evaluations(1.0, score, 2.0))
    with pytest.raises(ValueError, match="without evaluations"):
        store.add_run(ROW, finished(3), [])
    assert not store.folder.exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed,steps", "seeds,steps", "columns must be seed,steps"),
        ("1,128,3,0.25,2.0", "1,128,3,0.25", "line 3: 5 entries are needed, and there are 4"),
        ("1,128,3,0.25,2.0", "1,128,3,0.25,good", "line 3: score must be a number, got 'good'"),
        ("1,128,3,0.25,2.0", '1,128,3,0.25,"2.0', "not a CSV file"),
        ("1,128,3,0.25,2.0", "1,128,3,0.25,\xff", "not a CSV file"),
    ],
)
def test_a_damaged_file_is_named_and_left_alone(store: Store, old: str, new: str, message: str) -> None:
    store.add_run(ROW, finished(1), evaluations(1.0, 2.0))
    path = store.folder / "mpc__easy.csv"
    damaged = path.read_text().replace(old, new).encode("latin-1")
    path.write_bytes(damaged)
    for access in (
        lambda: store.evaluations(ROW),
        lambda: store.add_run(ROW, finished(2), evaluations(1.0)),
        lambda: store.add_run(ROW, finished(1), evaluations(1.0)),
    ):
        with pytest.raises(ResultFileError, match=r"mpc__easy\.csv") as caught:
            access()
        assert message in str(caught.value)
        assert path.read_bytes() == damaged and list(store.runs(ROW)) == [1]


def test_an_empty_file_is_a_damaged_one(store: Store) -> None:
    store.add_run(ROW, finished(1), evaluations(1.0))
    (store.folder / "mpc__easy.runs.csv").write_text("")
    with pytest.raises(ResultFileError, match=r"mpc__easy\.runs\.csv: its columns must be"):
        store.runs(ROW)
