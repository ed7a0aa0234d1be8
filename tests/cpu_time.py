"""A test without the marker ``slow`` may take three seconds of CPU time.

Above it the summary of the session warns, and above twice as much the test fails: the same test
takes up to 1.5 times as long on one machine where other programs use its cores. Its fixtures, which
several tests may share, do not count. On a slower processor than that of ``REFERENCE`` both limits
are higher in proportion. ``TEST_CPU_SECONDS`` in the environment sets another limit.
"""

import os
import resource
import time
from collections.abc import Generator

import pytest

LIMIT = float(os.environ.get("TEST_CPU_SECONDS", "3"))
REFERENCE = 0.017  # s, of ``_work`` on an Intel Xeon (AMX, 2023) with nothing else to do


def _cpu_seconds() -> float:
    """CPU time of this process and of the finished processes that it started."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _work() -> float:
    """CPU seconds of a fixed piece of work in Python."""
    begin = time.process_time()
    numbers: dict[int, int] = {}
    for number in range(200_000):
        numbers[number % 1000] = numbers.get(number % 999, 0) + number
    return time.process_time() - begin


SLOWNESS = max(1.0, min(_work() for _ in range(3)) / REFERENCE)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Run a test, and warn or fail if it took too long."""
    begin = _cpu_seconds()
    result = yield
    seconds = _cpu_seconds() - begin
    if "slow" in item.keywords or seconds <= LIMIT * SLOWNESS:
        return result
    text = f"{seconds:.1f} s of CPU time; a test without the marker slow may take {LIMIT:g} s"
    if seconds > 2 * LIMIT * SLOWNESS:
        pytest.fail(text, pytrace=False)
    item.warn(pytest.PytestWarning(text))
    return result
