"""Nonlinear programs, and their solution by IPOPT."""

import dataclasses
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from quadjax.limits.extra import casadi


class Monitor(casadi.Callback):
    """Stops IPOPT on request, and reports its iterations."""

    def __init__(
        self, sizes: tuple[int, int], stop: threading.Event, report: Callable[[float], object]
    ) -> None:
        casadi.Callback.__init__(self)
        self.sizes, self.stop, self.report = sizes, stop, report
        self.construct("monitor", {})

    def get_n_in(self) -> int:
        """The number of arguments of ``eval``."""
        return casadi.nlpsol_n_out()

    def get_n_out(self) -> int:
        """The number of its results."""
        return 1

    def get_name_in(self, index: int) -> str:
        """The name of an argument."""
        return casadi.nlpsol_out(index)

    def get_sparsity_in(self, index: int) -> Any:
        """The shape of an argument."""
        variables, constraints = self.sizes
        size = {"f": 1, "x": variables, "lam_x": variables, "g": constraints}
        name = casadi.nlpsol_out(index)
        size["lam_g"] = constraints
        return casadi.Sparsity.dense(size[name], 1) if name in size else casadi.Sparsity(0, 0)

    def eval(self, arguments: Sequence[Any]) -> list[int]:
        """Report the objective; 1 stops the solver."""
        self.report(float(arguments[1]))
        return [1 if self.stop.is_set() else 0]


class Program:
    """The variables, constraints and bounds of one nonlinear program."""

    def __init__(self) -> None:
        self.constraints: list[Any] = []
        self.low: list[np.ndarray] = []
        self.high: list[np.ndarray] = []

    def add(self, expression: Any, low: Any, high: Any) -> None:
        """Add ``low <= expression <= high``; columns of a matrix one after the other."""
        size = expression.numel()
        self.constraints.append(casadi.vec(expression))
        self.low.append(np.broadcast_to(np.asarray(low, float), (size,)))
        self.high.append(np.broadcast_to(np.asarray(high, float), (size,)))


@dataclasses.dataclass(frozen=True)
class Effort:
    """How long IPOPT iterates.

    Attributes:
        seconds: limit of processor time.
        max_iterations: limit of iterations.
        warm: the first values are close to a solution, as from a coarser mesh.
        stop: if set, the current iterate is returned.
        report: called at each iteration with the objective.
    """

    seconds: float = 300.0
    max_iterations: int = 1000
    warm: bool = False
    stop: threading.Event = dataclasses.field(default_factory=threading.Event)
    report: Callable[[float], object] = lambda value: None

    def options(self) -> dict[str, Any]:
        """IPOPT's options."""
        options = {
            "print_level": 0,
            "sb": "yes",
            "tol": 1e-6,
            "acceptable_tol": 1e-5,
            "max_iter": self.max_iterations,
            "max_cpu_time": max(0.1, self.seconds),
            "mu_init": 1e-4 if self.warm else 1e-2,
            "bound_relax_factor": 0.0,  # a motor map has no slope beyond its lowest command
        }
        return options | ({"bound_push": 1e-5, "bound_frac": 1e-5} if self.warm else {})


def minimize(
    program: Program,
    variables: Any,
    objective: Any,
    bounds: tuple[np.ndarray, np.ndarray],
    first: np.ndarray,
    effort: Effort,
) -> tuple[np.ndarray, bool, str]:
    """Solve a program by IPOPT.

    Args:
        program: its constraints.
        variables: (n, 1) symbols.
        objective: to be minimized.
        bounds: lowest and highest variables, (n,) each.
        first: (n,) initial values.
        effort: when the solver ends.

    Returns:
        The variables (n,), whether IPOPT converged, and its status.
    """
    constraints = casadi.vertcat(*program.constraints)
    sizes = variables.numel(), constraints.numel()
    options = {
        "print_time": False,
        "show_eval_warnings": False,
        "iteration_callback": Monitor(sizes, effort.stop, effort.report),
        "ipopt": effort.options(),
    }
    functions = {"x": variables, "f": objective, "g": constraints}
    solver = casadi.nlpsol("flight", "ipopt", functions, options)
    low, high = (np.concatenate(sides) for sides in (program.low, program.high))
    result = solver(x0=first, lbx=bounds[0], ubx=bounds[1], lbg=low, ubg=high)
    stats = solver.stats()
    return np.array(result["x"]).ravel(), bool(stats["success"]), str(stats["return_status"])
