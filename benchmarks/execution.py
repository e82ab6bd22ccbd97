"""Runs tasks in worker processes, and survives what happens to them.

A task that raises is a result like any other. A task whose process dies (killed, out of memory, a crash in native
code) takes the pool with it: those that were under way are then run again one at a time, so that the guilty one is
found, and the others go on.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from joblib import Parallel, delayed, parallel_config


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


class Backend(NamedTuple):
    """Where the worker processes are."""

    name: str
    """That joblib knows it by."""
    options: Mapping[str, Any]
    """Of :func:`joblib.parallel_config`."""
    jobs: int
    """How many tasks at a time."""


def loky(jobs: int) -> Backend:
    """Processes on this machine.

    :raises ValueError: ``jobs`` is not positive
    """
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {jobs!r}")
    # loky replaces a worker whose memory has grown; no task is lost by it
    warnings.filterwarnings("ignore", message="A worker stopped while some jobs were given to the executor")
    return Backend("loky", {"inner_max_num_threads": 1, "initializer": _watcher(os.getpid())}, jobs)


def ray(address: str | None = None, jobs: int | None = None) -> Backend:
    """Processes of a Ray cluster, whose machines have the same packages and this repository on their Python path.

    :param address: of the cluster; without it, and without ``RAY_ADDRESS``, one is started on this machine
    :param jobs: at most as many as the cluster has cores, and all of those without it
    :raises ImportError: Ray is not installed
    :raises ConnectionError: there is no cluster at this address
    :raises ValueError: ``jobs`` is out of range, or the cluster has a single core
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray as ray_package
    from joblib import register_parallel_backend
    from ray.util.joblib import register_ray
    from ray.util.joblib.ray_backend import RayBackend

    class StreamingRayBackend(RayBackend):
        """Ray's own, but results come as soon as they are there, and a call waits for no process that is busy.

        The first only takes a flag. The second: Ray's pool hands calls to its processes in turn, where one may queue
        behind a run of an hour while another process idles.
        """

        supports_return_generator = True

        def configure(self, *args: Any, **kwargs: Any) -> int:
            n_jobs = super().configure(*args, **kwargs)
            self._idle = list(range(n_jobs))
            return n_jobs

        def submit(self, func: Callable[[], Any], callback: Callable[[Any], Any]) -> Any:
            process = self._idle.pop()  # no more calls are under way than there are processes
            self._get_pool()._next_actor_index = lambda: process

            def done(result: Any) -> None:
                self._idle.append(process)
                callback(result)

            return super().submit(func, done)

    if jobs is not None and jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {jobs!r}")
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address == "local":
        ray_package.init("local", num_cpus=max(2, jobs or os.cpu_count() or 2), include_dashboard=False, **quiet)
    else:
        ray_package.init(address, **quiet)
    cores = int(ray_package.cluster_resources().get("CPU", 0))
    if cores < 2 or (jobs or 1) > cores:
        raise ValueError(f"jobs must be at most the number of cores of the cluster, {cores}, of which 2 are needed")
    register_ray()
    register_parallel_backend("streaming ray", StreamingRayBackend)
    return Backend("streaming ray", {}, jobs or cores)


class Executor:
    """Runs tasks, some at a time, each in a worker process with one thread.

    :param backend: :func:`loky` or :func:`ray`
    :param on_message: is told of what goes wrong meanwhile
    """

    def __init__(self, backend: Backend, on_message: Callable[[str], None] = print) -> None:
        self.backend = backend
        self.on_message = on_message
        self.under_way: dict[str, float] = {}
        """Names of the tasks that were given to workers, and when (:func:`time.monotonic`)."""

    def outcomes(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """What comes of the tasks, as soon as it does. They are begun in their order.

        To close the generator early is to stop the workers.
        """
        waiting = {task.name: task for task in tasks}
        while waiting:
            try:
                with contextlib.closing(self._run(list(waiting.values()), self.backend.jobs)) as outcomes:
                    for outcome in outcomes:
                        del waiting[outcome.task.name]
                        yield outcome
            except Exception as death:  # of a worker: what a task raises is an outcome
                suspects = [waiting.pop(name) for name in list(self.under_way) if name in waiting]
                if not suspects:
                    raise
                self.on_message(
                    f"A worker process died ({_line(death)}). Under way were, and are run again one at a time: "
                    + "; ".join(task.name for task in suspects)
                )
                for suspect in suspects:
                    yield self._alone(suspect)

    def _alone(self, task: Task) -> Outcome:
        """Run one task with no other beside it, so that there is no doubt whose fault it is when the process dies."""
        try:
            with contextlib.closing(self._run([task], 1)) as outcomes:
                return next(outcomes)
        except Exception as death:
            reason = f"its worker process died, twice: {_line(death)}"
            return Outcome(task, None, Failure(reason, reason))

    def _run(self, tasks: Sequence[Task], jobs: int) -> Generator[Outcome, None, None]:
        by_name = {task.name: task for task in tasks}
        self.under_way.clear()

        def calls() -> Iterator[Any]:
            for task in tasks:
                self.under_way[task.name] = time.monotonic()
                yield delayed(_attempt)(task)

        # With n_jobs=1 joblib would use this very process, whose death ends everything: one of two workers idles.
        # As many calls are handed out as there are jobs, and the next when one comes back: those are under way.
        with parallel_config(self.backend.name, **self.backend.options):
            parallel = Parallel(n_jobs=max(2, jobs), pre_dispatch=jobs, batch_size=1, return_as="generator_unordered")
            results = parallel(calls())
            try:
                for name, result in results:
                    del self.under_way[name]
                    failed = isinstance(result, Failure)
                    yield Outcome(by_name[name], None if failed else result, result if failed else None)
            finally:
                with warnings.catch_warnings():
                    warnings.filterwarnings("ignore", message=".*still being processed")  # whoever stops knows it
                    results.close()


def _attempt(task: Task) -> tuple[str, Any]:
    """In a worker: the name of a task, and its result or its failure."""
    try:
        return task.name, task.function(*task.arguments)
    except (Exception, SystemExit) as error:
        return task.name, Failure(_line(error), traceback.format_exc())


def _line(error: BaseException) -> str:
    """An exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


@functools.cache  # one and the same, or else loky starts new workers for each call
def _watcher(parent: int) -> Callable[[], None]:
    return functools.partial(_end_with, parent)


def _end_with(parent: int) -> None:
    """In a worker: end when the process that started it is gone, not when the task is done for nobody."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
