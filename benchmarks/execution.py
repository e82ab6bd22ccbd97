"""Runs tasks in worker processes, and survives what happens to them.

A task that raises is a result like any other. A task whose process dies (killed, out of memory, a crash in native
code) takes the pool with it: those that were under way are then run again one at a time, so that the guilty one is
found, and the others go on.
"""

from __future__ import annotations

import functools
import os
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, NamedTuple

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError


class Task(NamedTuple):
    """A call that can be sent to another process."""

    name: str
    """For messages, such as ``mpc/easy, seed 1000``; no two tasks have the same."""
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


class Failure(NamedTuple):
    """Why a task came to nothing."""

    reason: str
    """One line."""
    details: str
    """A traceback, or the reason again."""


class Outcome(NamedTuple):
    """What came of a task."""

    task: Task
    result: Any
    """What its function returned; None when it failed."""
    failure: Failure | None


class Executor:
    """Runs tasks, some at a time, each in a worker process with one thread.

    :param jobs: how many at a time
    :param on_message: is told of what goes wrong meanwhile
    """

    def __init__(self, jobs: int, on_message: Callable[[str], None] = print) -> None:
        if jobs < 1:
            raise ValueError(f"jobs must be at least 1, got {jobs!r}")
        self.jobs = jobs
        self.on_message = on_message
        self.under_way: dict[str, float] = {}
        """Names of the tasks that were given to workers, and when (:func:`time.monotonic`)."""

    def outcomes(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """What comes of the tasks, as soon as it does. They are begun in their order.

        To close the iterator early is to stop the workers.
        """
        waiting = list(tasks)
        while waiting:
            done = set()
            try:
                for outcome in self._run(waiting, self.jobs):
                    done.add(outcome.task.name)
                    yield outcome
            except TerminatedWorkerError as death:
                suspects = [task for task in waiting if task.name in self.under_way and task.name not in done]
                names = "; ".join(task.name for task in suspects)
                self.on_message(f"A worker process died. Under way were, and are now run one at a time: {names}")
                for suspect in suspects:
                    done.add(suspect.name)
                    yield self._alone(suspect, death)
            finally:
                self.under_way.clear()
            waiting = [task for task in waiting if task.name not in done]

    def _alone(self, task: Task, death: Exception) -> Outcome:
        """Run one task with no other beside it, so that there is no doubt whose fault it is when the process dies."""
        try:
            (outcome,) = self._run([task], 1)
        except TerminatedWorkerError as again:
            reason = "its worker process died, twice: killed, out of memory, or a crash in native code"
            return Outcome(task, None, Failure(reason, f"{reason}\n\n{death}\n\n{again}"))
        return outcome

    def _run(self, tasks: Sequence[Task], jobs: int) -> Iterator[Outcome]:
        def calls() -> Iterator[Any]:
            for task in tasks:
                self.under_way[task.name] = time.monotonic()
                yield delayed(_attempt)(task)

        # With n_jobs=1 joblib would use this very process, whose death ends everything: one of two workers idles.
        # As many calls are handed out as there are jobs, and the next when one comes back: those are under way.
        with parallel_config("loky", inner_max_num_threads=1):
            results = Parallel(n_jobs=max(2, jobs), pre_dispatch=jobs, batch_size=1, return_as="generator_unordered")(
                calls()
            )
            for name, result in results:
                del self.under_way[name]
                task = next(task for task in tasks if task.name == name)
                failed = isinstance(result, Failure)
                yield Outcome(task, None if failed else result, result if failed else None)


def _attempt(task: Task) -> tuple[str, Any]:
    """In a worker: the name of a task, and its result or its failure."""
    _end_with_parent()
    try:
        return task.name, task.function(*task.arguments)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        return task.name, Failure(reason, traceback.format_exc())


@functools.cache
def _end_with_parent() -> None:
    """Let this worker end when the process that started it is gone, not when its task is done for nobody."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
