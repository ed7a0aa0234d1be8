"""Optuna, which is an extra: one line that names it where it is not installed."""

from quadjax.core.errors import InputError

try:
    import optuna
except ImportError:
    raise InputError(
        "sweeps need Optuna, which is not installed: pip install -e '.[sweep]'"
    ) from None

optuna.logging.set_verbosity(optuna.logging.ERROR)

__all__ = ["optuna"]
