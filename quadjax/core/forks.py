"""Processes that were forked after JAX had started: their first computation waits forever.

The threads of JAX do not exist in the child, its locks do. ``quadjax`` imports this module, so that
forks of a program that imports it are known.
"""

import os
import sys

from quadjax.core.errors import InputError

_started = False  # JAX, before the last fork
_forked = False  # this process, after JAX had started


def _before() -> None:
    global _started
    _started = _jax_has_started()


def _jax_has_started() -> bool:
    """Whether JAX has started; in a version that does not tell, whether it is imported.

    Its public functions start it, so none of them tells.
    """
    bridge = sys.modules.get("jax._src.xla_bridge")
    has_started = getattr(bridge, "backends_are_initialized", None)
    return "jax" in sys.modules if has_started is None else bool(has_started())


def _in_child() -> None:
    global _forked
    _forked = _forked or _started


if hasattr(os, "register_at_fork"):  # not on Windows, which has no forks
    os.register_at_fork(before=_before, after_in_child=_in_child)


def refuse_forked(instead: str = "") -> None:
    """Refuse to compute in a process that was forked after JAX had started.

    Args:
        instead: what needs no process, for the message.

    Raises:
        InputError: this is such a process.
    """
    if _forked:
        spawned = "a process that is spawned (multiprocessing: context='spawn')"
        allowed = f"{instead}, or {spawned}" if instead else spawned
        raise InputError(f"this process was forked after JAX had started, allowed: {allowed}")
