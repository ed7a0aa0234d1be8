"""Workers as Ray tasks on a running cluster, with the CPUs and GPUs that a trial requests."""

from pathlib import Path
from typing import Any

from quadjax.core.errors import InputError
from quadjax.sweeps.sweep import Sweep
from quadjax.sweeps.workers import Function, use_device, work

try:
    import ray
except ImportError:
    raise InputError("executor.kind is ray: pip install 'quadjax[ray]'") from None


def _task(gpus: float, *arguments: Any) -> None:
    visible = ray.get_gpu_ids()
    use_device(",".join(map(str, visible)) if visible else None, gpus)
    work(*arguments)


class RayWorkers:
    """Tasks on a Ray cluster. The output folder must be on a file system that all nodes share."""

    def __init__(self, sweep: Sweep, directory: Path, function: Function, end: float) -> None:
        """Connect to the cluster; ``InputError`` where none answers or has room for a trial."""
        asked = sweep.file.executor
        if not ray.is_initialized():
            try:
                ray.init(address=asked.address, log_to_driver=False)
            except (ConnectionError, ValueError) as error:
                hint = "no Ray cluster answers; start one with ray start --head"
                raise InputError(f"executor.address is {asked.address}: {hint}") from error
        need = {"CPU": asked.cpus, "GPU": asked.gpus}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        room = sum(
            min(int(node.get(kind, 0.0) / n + 1e-9) for kind, n in need.items() if n)
            for node in nodes
        )
        if not room:
            raise InputError(f"executor: no node has {asked.cpus:g} CPUs and {asked.gpus:g} GPUs")
        self.count = asked.workers or room
        options = {"num_cpus": asked.cpus, "num_gpus": asked.gpus, "max_retries": 0}
        self._task = ray.remote(_task).options(**options)  # the study retries
        self._arguments = (asked.gpus, sweep, directory, function, end)

    def start(self, slot: int, name: str) -> Any:
        """Start a worker as soon as a node has room for it."""
        return self._task.remote(*self._arguments, slot, name)

    def reason(self, task: Any) -> str | None:
        """None while a worker runs or waits; "" if it ended by itself; else why it died."""
        if not ray.wait([task], timeout=0)[0]:
            return None
        try:
            ray.get(task)
        except ray.exceptions.RayError as error:
            lines = str(error).strip().splitlines() or [""]
            return f"{type(error).__name__}: {lines[-1]}"
        return ""

    def stop(self, task: Any) -> None:
        """Ask a worker to save its trial and to end."""
        ray.cancel(task)
