"""Which tests may be skipped in CI; any other skip fails the session where ``CI`` is set.

Elsewhere a missing tool skips the tests that need it, and the summary lists them.
"""

import os

import pytest

ALLOWED = (  # the beginning of a test's id, and a part of the reason
    # The extras torch and sb3 are not among those of the tests.
    ("tests/policy/test_torch_files.py", "the extra torch is not installed"),
    ("tests/policy/test_torch_files.py", "the extra sb3 is not installed"),
    ("tests/test_gym.py", "the extra sb3 is not installed"),
    ("tests/learners/test_sb3_update.py", "the extra sb3 is not installed"),
    # Files of other authors, which the repository must not contain.
    ("tests/fitting/", "no logs of real flights"),
    ("tests/policy/test_c_networks.py", "no files of the authors"),
)


def _not_allowed(config: pytest.Config) -> list[str]:
    """The skips that are no part of ``ALLOWED``, a line each."""
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    skipped = {(each.nodeid, _reason(each)) for each in reporter.stats.get("skipped", [])}
    return sorted(
        f"{test}: {reason}"
        for test, reason in skipped
        if not any(test.startswith(t) and r in reason for t, r in ALLOWED)
    )


def _reason(report: pytest.TestReport | pytest.CollectReport) -> str:
    text = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return text.removeprefix("Skipped: ")


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Fail a session that is green by a skip that is not allowed."""
    if "CI" in os.environ and exitstatus == 0 and not hasattr(session.config, "workerinput"):
        if _not_allowed(session.config):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Print the skips that fail the session in CI."""
    if "CI" in os.environ:
        for line in _not_allowed(config):
            terminalreporter.write_line(f"not allowed in CI to skip {line}", red=True)
