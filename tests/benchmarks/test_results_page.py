"""The page says what the result files say, with some of them missing, damaged, or not there at all."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from PIL import Image

from benchmarks import experiments, results_page, tables
from benchmarks.evaluation import Evaluation
from benchmarks.experiments import Experiment
from benchmarks.reading import Results
from benchmarks.results_page import FIGURES, PAGE, TABLES, TEMPLATE
from benchmarks.store import FinishedRun, Store

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
KINDS = {"table": TABLES, "figure": FIGURES}


@pytest.fixture(scope="module")
def table() -> list[Experiment]:
    return experiments.read_table(experiments.TABLE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "results" / "runs"


def add(folder: Path, name: str, env: str, scores: dict[int, list[float]], every: int = 128, **changes) -> None:
    """Finished runs, by seed; a step takes 0.01 s, a rollout 64 steps; the oracle scores 1,000."""
    for seed, of_seed in scores.items():
        finished = FinishedRun(
            seed, env, "abc", 1_000.0, 900.0, 60.0, "0123abc", "A processor, 2 cores", "python=3.11", "2026-01-02T03:04"
        )
        run = [Evaluation(every * i, every * i // 64, 0.01 * every * i, score) for i, score in enumerate(of_seed)]
        Store(folder).add_run(name, finished._replace(**changes), run)


def make(folder: Path, output: Path) -> tuple[int, str]:
    """Exit status and page, dashes as hyphens."""
    status = results_page.main(["--results", str(folder), "--output", str(output)])
    return status, (output / PAGE).read_text(encoding="utf-8").replace(tables.DASH, "-")


def everything(folder: Path, table: list[Experiment]) -> None:
    """Two runs of every row, a probe of each kind, and the files of other commands."""
    for row in table:
        add(folder, row.name, row.env, {1000: [100, 960, 980], 1001: [100, -5_000, 970]})
        for seed in (1000, 1001):
            found = {
                "episode": [
                    {"step": step, "quantity": name, "value": 0.1}
                    for step in (0, 2, 3)
                    for name in ("state 0", "state 2", "reward", "return")
                ],
                "robustness": [{"change": "pole mass", "amount": 0.7, "quantity": "score", "value": 480.0 + seed}],
                "reuse": [
                    {"task": "hold", "controller": name, "quantity": "score", "value": value}
                    for name, value in (("learned", 500 + seed), ("oracle", 2_000.0), ("lqr", 1_700.0))
                ],
                "model_quality": [
                    {"model": "learned", "motion": "free", "steps": 1, "quantity": "error", "value": 0.25},
                    {"model": "true", "motion": "free", "steps": 1, "quantity": "error", "value": 0.125},
                    {"model": "learned", "matrix": "A", "contact": "", "quantity": "error", "value": 0.0625},
                    {"model": "learned", "matrix": "D", "contact": "0", "quantity": "error", "value": 0.5},
                    {"model": "learned", "matrix": "effect", "contact": "0", "quantity": "error", "value": 0.75},
                    {"model": "learned", "matrix": "effect", "contact": "1", "quantity": "error", "value": 1.0},
                    {"model": "learned", "quantity": "spurious contacts", "value": 3.0},
                ],
            }
            for probe in row.probes:
                Store(folder).add_probe(row.name, seed, probe, found[probe])
    references = ["env,controller,change,amount,quantity,value"]
    for env in {row.env for row in table}:
        references += [f"{env},oracle,nothing,0.0,score,1480", f"{env},informed oracle,pole mass,0.7,score,1480"]
    (folder.parent / "robustness_references.csv").write_text("\n".join(references) + "\n")
    (folder.parent / "rivals_pets.csv").write_text("seed,steps,rollouts,seconds,score\n1000,200,6,4.5,777.0\n")
    older = "env,variant,seed,steps,rollouts,seconds,score,oracle\nHard-v0,tuned,1000,640,7,5.5,960,1000\n"
    (folder.parent / "learned_contacts.csv").write_text(older)


# -- the template --


def test_the_template_uses_each_table_and_figure_once() -> None:
    found = re.findall(r"\{\{(.*?)\}\}", TEMPLATE.read_text(encoding="utf-8"))
    assert sorted(found) == sorted(f"{kind}: {name}" for kind, known in KINDS.items() for name in known)


@pytest.mark.parametrize("placeholder", ["table: nothing", "figure: solve", "solve", "table:solve"])
def test_an_unknown_placeholder_is_refused(folder: Path, tmp_path: Path, placeholder: str) -> None:
    with pytest.raises(ValueError, match=re.escape(repr(placeholder))):
        results_page.page(Results(folder, []), tmp_path, f"{{{{{placeholder}}}}}")


def test_every_command_of_the_page_names_rows_of_the_table(table: list[Experiment]) -> None:
    for _, *_, source in [*TABLES.values(), *FIGURES.values()]:
        if source is not None and source.patterns:
            assert experiments.selected(table, source.patterns)


# -- the page --


def test_everything_is_drawn_and_told(folder: Path, tmp_path: Path, table: list[Experiment]) -> None:
    everything(folder, table)
    status, page = make(folder, tmp_path / "docs")
    assert status == 0 and "{{" not in page and "Not run" not in page
    for name in FIGURES:
        path = Path("images") / f"results_{name}.png"
        assert f"]({path.as_posix()})" in page
        assert (tmp_path / "docs" / path).stat().st_size < 200_000
        with Image.open(tmp_path / "docs" / path) as picture:
            assert picture.width == 1_200
    # solved by the first and the second evaluation, of 2 and 4 rollouts, 128 and 256 steps
    line = "| `mpc/easy/drake` | 2 | 256 | 2/2 | 2/2 | 3 [2.50, 3.50] (4) | 192 [160, 224] | 1.92 [1.60, 2.24] | 975 |"
    assert line in page
    assert "| PPO + MPC | 2 | 4 | 0.975 |" in page
    assert "| `mpc/hard/pybullet` | in free motion | 1 | 0.250 | 0.125 |" in page
    # one contact of two is found in both runs
    assert "| `mpc/hard/pybullet` | 0.062 | - | - | 0.500 | - | - | 0.875 | 2/4 | 6 |" in page
    assert "| `mpc/hard/pybullet` | hold | 1,500 (1,500 to 1,501) | 2,000 | 1,700 |" in page
    assert "| 200 | 6 | 4.50 | 777 | 128 | 2 | 1.28 | −2,020 |" in page
    assert "| `learned_contacts` | 1 | 640 | 1/1 | 1/1 | 7 [7, 7] (7) |" in page
    assert "| A processor, 2 cores |" in page and "`0123abc` | python 3.11 |" in page


def test_nothing_at_all_makes_a_page_that_says_so(folder: Path, tmp_path: Path) -> None:
    status, page = make(folder, tmp_path / "docs")
    assert status == 0
    assert page.count("*Not run.*") == len(TABLES) + len(FIGURES)
    assert "`mpc/easy/drake`" in page and "![" not in page


def test_ratios_are_to_the_best_baseline_of_the_same_engine(folder: Path, tmp_path: Path) -> None:
    add(folder, "mpc/easy/drake", "A-v0", {0: [0, 990]})
    add(folder, "mpc/easy/pybullet", "B-v0", {0: [0, 990]})
    add(folder, "baseline/ppo-defaults/easy/pybullet", "B-v0", {0: [0, 0, 990]}, every=12_800)
    add(folder, "baseline/ppo-tuned-v1/easy/pybullet", "B-v0", {0: [0, 0]}, every=1_280)
    _, page = make(folder, tmp_path / "docs")
    best = "`baseline/ppo-defaults/easy/pybullet`"
    assert f"| cart-pole, ±100 N, PyBullet | {best} | rollouts | 400 | 2 | 200 | ≥ 60 |" in page
    assert f"| cart-pole, ±100 N, PyBullet | {best} | steps | 25,600 | 128 | 200 | ≥ 200 |" in page
    assert "| cart-pole, ±100 N, Drake | - | steps | - | 128 | - | ≥ 200 |" in page


def test_the_least_that_an_unsolved_baseline_needs_is_marked(folder: Path, tmp_path: Path) -> None:
    add(folder, "mpc/easy/drake", "A-v0", {0: [0, 990]})
    add(folder, "baseline/ppo-defaults/easy/drake", "A-v0", {0: [0, 0]}, every=12_800)
    _, page = make(folder, tmp_path / "docs")
    assert "| `baseline/ppo-defaults/easy/drake` | steps | > 12,800 | 128 | > 100 | ≥ 200 |" in page
    assert "| `baseline/ppo-defaults/easy/drake` | 1 | 12,800 | 0/1 | 0/1 | - | - | - | 0 |" in page


@pytest.mark.parametrize(
    "name, text",
    [
        ("mpc__easy__drake.csv", "seed,steps\n0,128\n"),
        ("mpc__easy__drake.csv", "seed,steps,rollouts,seconds,score\n0,128,2,1.0,nan\n"),
        ("mpc__easy__drake.csv", "seed,steps,rollouts,seconds,score\n"),
        ("mpc__easy__drake.runs.csv", "\x00"),
        ("mpc__easy__drake.runs.csv", None),
        ("../rivals_pets.csv", "seed,steps\n0,x\n"),
        ("../rivals_pets.csv", "seed,steps,rollouts,seconds,score\n0,128\n"),
        ("../learned_contacts.csv", "env,seed\na,b\n"),
    ],
)
def test_a_damaged_file_is_named_and_left_out(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, text: str | None
) -> None:
    add(folder, "mpc/easy/drake", "A-v0", {0: [0, 990]})
    add(folder, "mpc/easy/pybullet", "B-v0", {0: [0, 990]})
    if text is None:  # runs of different settings, which say nothing together
        add(folder, "mpc/easy/drake", "A-v0", {1: [0, 990]}, settings="other")
    else:
        (folder / name).write_text(text)
    status, page = make(folder, tmp_path / "docs")
    assert status == 1
    assert Path(name).name.split(".")[0] in capsys.readouterr().err
    assert "| `mpc/easy/pybullet` | 1 |" in page
    assert ("| `mpc/easy/drake` | 1 |" in page) == name.startswith("..")


def test_a_table_of_experiments_that_can_not_be_read_is_an_error(tmp_path: Path) -> None:
    assert results_page.main(["--output", str(tmp_path), "--table", str(tmp_path / "none.yml")]) == 2
    assert not (tmp_path / PAGE).exists()


@pytest.mark.parametrize(
    "value, shown",
    [
        (12_345.6, "12,346"),
        (-5.25, "−5.25"),
        (2.0, "2"),
        (0.1234, "0.123"),
        (None, tables.DASH),
        (float("inf"), tables.DASH),
    ],
)
def test_numbers_are_shown_with_three_digits(value: float | None, shown: str) -> None:
    assert tables.number(value) == shown


# -- what is committed --


def test_the_committed_page_is_what_the_command_makes(tmp_path: Path) -> None:
    status, page = make(ROOT / "benchmarks" / "results" / "runs", tmp_path)
    assert status == 0
    assert page == (DOCS / PAGE).read_text(encoding="utf-8").replace(tables.DASH, "-")
    for picture in (tmp_path / "images").iterdir():
        assert (DOCS / "images" / picture.name).exists()
    assert Path(PAGE).stem in (DOCS / "index.md").read_text(encoding="utf-8").split()
