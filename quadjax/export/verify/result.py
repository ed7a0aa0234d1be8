"""What a check found, and the table of all of them."""

import dataclasses
import time
from collections.abc import Callable

PASSED, FAILED, LEFT_OUT = "pass", "FAIL", "left out"


@dataclasses.dataclass(frozen=True)
class Result:
    """One row of the table."""

    check: str
    verdict: str  # PASSED | FAILED | LEFT_OUT
    figure: str  # what was measured, or why it was left out
    seconds: float = 0.0


class LeftOut(Exception):
    """A check that this machine cannot run; the message says why."""


class Failed(Exception):
    """A check that ran and failed; the message says how."""


def run_check(name: str, check: Callable[[], str]) -> Result:
    """Run one check, which returns its figure or raises ``LeftOut`` or ``Failed``."""
    start = time.monotonic()
    try:
        verdict, figure = PASSED, check()
    except LeftOut as reason:
        verdict, figure = LEFT_OUT, str(reason)
    except Failed as reason:
        verdict, figure = FAILED, str(reason)
    except Exception as error:  # a check that breaks has not passed
        verdict, figure = FAILED, f"{type(error).__name__}: {error}"
    return Result(name, verdict, " ".join(figure.split()), time.monotonic() - start)


def require(condition: bool, message: str) -> None:
    """Raise ``Failed`` with the message unless the condition holds."""
    if not condition:
        raise Failed(message)


def table_text(results: list[Result]) -> str:
    """The table as text."""
    width = max(len(result.check) for result in results)
    lines = []
    for r in results:
        lines.append(f"{r.check:<{width}}  {r.verdict:<8}  {r.seconds:6.1f} s  {r.figure}")
    counts = {v: sum(r.verdict == v for r in results) for v in (PASSED, FAILED, LEFT_OUT)}
    lines.append("")
    lines.append(
        f"{counts[PASSED]} passed, {counts[FAILED]} failed, {counts[LEFT_OUT]} left out; "
        f"{sum(r.seconds for r in results):.0f} s"
    )
    return "\n".join(lines)
