"""Trials as Ray tasks on a running cluster, with the CPUs and GPUs that each requests."""

import contextlib
import os
import uuid
from typing import Any

from quadjax.core.errors import InputError
from quadjax.sweeps.local import Function, WorkerDied
from quadjax.sweeps.schema import Executor
from quadjax.sweeps.trial import Job, Outcome, Tell

try:
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ImportError:
    ray = None

POLL_SECONDS = 0.5


class Mailbox:
    """Reports of running trials and the answer whether to stop; a Ray actor."""

    def __init__(self) -> None:
        self._reports: dict[str, list[tuple[int, float]]] = {}
        self._stopped: set[str] = set()

    def tell(self, trial: str, step: int, value: float) -> bool:
        """Store a report; returns whether the trial is to stop."""
        self._reports.setdefault(trial, []).append((step, value))
        return trial in self._stopped

    def take(self, trial: str, stop: bool) -> list[tuple[int, float]]:
        """The reports since the last call; with ``stop`` the trial stops."""
        self._stopped |= {trial} if stop else set()
        return self._reports.pop(trial, [])


def _task(function: Function, job: Job, trial: str, mailbox: Any, gpus: float) -> Outcome:
    if gpus < 1:  # JAX allocates three quarters of a GPU's memory by default
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{0.9 * gpus:.3f}")

    def tell(step: int, value: float) -> bool:
        return ray.get(mailbox.tell.remote(trial, step, value))

    return Outcome((), 0.0, False) if tell(-1, 0.0) else function(job, tell)


class RayExecutor(contextlib.AbstractContextManager):
    """Tasks on a Ray cluster. The output folder must be on a file system that all nodes share."""

    def __init__(self, asked: Executor, function: Function) -> None:
        """Connect to the cluster; ``InputError`` where none answers or has room for a trial."""
        if ray is None:
            raise InputError("executor.kind is ray: pip install 'quadjax[ray]'")
        if not ray.is_initialized():
            try:
                ray.init(address=asked.address, log_to_driver=False)
            except (ConnectionError, ValueError) as error:
                hint = "no Ray cluster answers; start one with ray start --head"
                raise InputError(f"executor.address is {asked.address}: {hint}") from error
        each = {"CPU": asked.cpus, "GPU": asked.gpus}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        room = sum(
            min(int(node.get(kind, 0.0) / n + 1e-9) for kind, n in each.items() if n)
            for node in nodes
        )
        if not room:
            raise InputError(f"executor: no node has {asked.cpus:g} CPUs and {asked.gpus:g} GPUs")
        self.workers, self._function, self._gpus = asked.workers or room, function, asked.gpus
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        self._mailbox = ray.remote(Mailbox).options(num_cpus=0, scheduling_strategy=here).remote()
        needs = {"num_cpus": asked.cpus, "num_gpus": asked.gpus}
        self._task = ray.remote(_task).options(**needs, max_retries=0)  # the study retries

    def run(self, job: Job, tell: Tell) -> Outcome:
        """Run a trial where the cluster has room; ``WorkerDied`` if its process or node dies."""
        trial = uuid.uuid4().hex
        task = self._task.remote(self._function, job, trial, self._mailbox, self._gpus)
        stop = False
        try:
            while not ray.wait([task], timeout=POLL_SECONDS)[0]:
                reports = ray.get(self._mailbox.take.remote(trial, stop))
                stop = any([tell(*report) for report in [*reports, (-1, 0.0)]])
            return ray.get(task)
        except ray.exceptions.RayError as error:
            reason = str(error).strip().splitlines() or [""]
            raise WorkerDied(f"{type(error).__name__}: {reason[-1]}") from error

    def __exit__(self, *error: object) -> None:
        """Do nothing: the cluster keeps running."""
