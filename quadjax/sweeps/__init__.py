"""Hyperparameter sweeps with Optuna, in local processes or on Ray."""

import warnings

from quadjax.core.errors import InputError

try:
    import optuna
except ImportError:
    raise InputError("sweeps need Optuna: pip install 'quadjax[sweep]'") from None

warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
warnings.filterwarnings("ignore", category=UserWarning, module=r"optuna\.")
optuna.logging.set_verbosity(optuna.logging.ERROR)
