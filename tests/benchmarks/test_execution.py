"""Whatever happens to one task, the others are done, and it is known which one it was."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from benchmarks import execution
from benchmarks.execution import Backend, Executor, Outcome, Task


@pytest.fixture(
    scope="module",
    params=["loky", pytest.param("ray", marks=pytest.mark.slow)],
)
def backend(request: pytest.FixtureRequest) -> Iterator[Backend]:
    if request.param == "loky":
        yield execution.loky(2)
    else:
        ray = pytest.importorskip("ray")
        yield execution.ray("local", 2)
        ray.shutdown()


def run(backend: Backend, *tasks: Task) -> tuple[dict[str, Outcome], list[str]]:
    """Outcomes by name, and what was said meanwhile."""
    said: list[str] = []
    outcomes = list(Executor(backend, said.append).outcomes(tasks))
    by_name = {outcome.task.name: outcome for outcome in outcomes}
    assert len(by_name) == len(outcomes) == len(tasks)
    return by_name, said


def test_tasks_are_done_in_processes_of_their_own(backend: Backend) -> None:
    outcomes, said = run(backend, *(Task(f"{i}", os.getpid, ()) for i in range(3)))
    assert os.getpid() not in {outcome.result for outcome in outcomes.values()}
    assert all(outcome.failure is None for outcome in outcomes.values())
    assert said == []


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        pytest.param(Task("bad", int, ("x",)), "ValueError: invalid literal", id="raises"),
        pytest.param(Task("bad", sys.exit, ("enough",)), "SystemExit: enough", id="exits"),
    ],
)
def test_a_task_that_raises_is_told_and_the_others_go_on(backend: Backend, task: Task, reason: str) -> None:
    outcomes, said = run(backend, task, *(Task(f"{i}", math.sqrt, (i,)) for i in range(4)))
    failure = outcomes.pop("bad").failure
    assert failure is not None and failure.reason.startswith(reason)
    assert "Traceback" in failure.details
    assert {name: outcome.result for name, outcome in outcomes.items()} == {f"{i}": math.sqrt(i) for i in range(4)}
    assert said == []


def test_a_worker_that_dies_takes_no_other_task_with_it(backend: Backend) -> None:
    """The sleeper is under way when its neighbour dies, and is done again; the rest follows."""
    outcomes, said = run(
        backend,
        Task("sleeper", time.sleep, (2.0,)),
        Task("dies", os._exit, (3,)),
        *(Task(f"waits {i}", math.sqrt, (i,)) for i in range(4)),
    )
    failure = outcomes.pop("dies").failure
    assert failure is not None and failure.reason.startswith("its worker process died")
    assert all(outcome.failure is None for outcome in outcomes.values())
    assert outcomes["waits 3"].result == math.sqrt(3)
    assert len(said) == 1 and "dies" in said[0] and "sleeper" in said[0]
    assert "waits" not in said[0]


def test_each_of_several_that_die_is_found(backend: Backend) -> None:
    outcomes, _ = run(backend, Task("a", os._exit, (1,)), Task("fine", math.sqrt, (4.0,)), Task("b", os._exit, (1,)))
    assert {name for name, outcome in outcomes.items() if outcome.failure} == {"a", "b"}
    assert outcomes["fine"].result == 2.0


def test_results_come_when_they_are_there_not_when_all_are(backend: Backend) -> None:
    tasks = [Task("long", time.sleep, (1.0,)), *(Task(f"{i}", math.sqrt, (i,)) for i in range(3))]
    names = [outcome.task.name for outcome in Executor(backend).outcomes(tasks)]
    assert names[-1] == "long" and len(names) == 4


def test_one_job_is_a_process_too_and_keeps_the_order() -> None:
    executor = Executor(execution.loky(1))
    outcomes = list(executor.outcomes([Task(f"{i}", os.getpid, ()) for i in range(4)]))
    assert [outcome.task.name for outcome in outcomes] == ["0", "1", "2", "3"]
    assert os.getpid() not in {outcome.result for outcome in outcomes}


def test_what_is_under_way_is_known() -> None:
    executor = Executor(execution.loky(2))
    outcomes = executor.outcomes([Task("short", time.sleep, (0.0,)), Task("long", time.sleep, (30.0,))])
    assert next(outcomes).task.name == "short"
    assert list(executor.under_way) == ["long"]
    begun = time.monotonic()
    outcomes.close()
    assert time.monotonic() - begun < 20.0  # it did not wait for the end


def test_workers_end_with_the_process_that_wanted_their_results() -> None:
    code = (
        "import os, time; from benchmarks import execution as e\n"
        "outcomes = e.Executor(e.loky(2)).outcomes([e.Task('a', int, ()), e.Task('z', time.sleep, (600,))])\n"
        "next(outcomes); os.kill(os.getpid(), 9)"
    )
    # it is over when nobody holds the other end of the pipe, workers included
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=False, timeout=120)
    assert done.returncode == -9


@pytest.mark.parametrize("jobs", [0, -1])
def test_a_number_of_jobs_that_is_none(jobs: int) -> None:
    with pytest.raises(ValueError, match="jobs must be"):
        execution.loky(jobs)
