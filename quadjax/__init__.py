"""quadjax: time-optimal quadcopter racing policies, from simulation to fixed-point C.

The names below are the public interface. Each is imported when it is first used, so that
``import quadjax`` takes milliseconds and does not import JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from quadjax.config.loading import load_config as load
    from quadjax.config.race import make_race
    from quadjax.config.schema import Config
    from quadjax.core.environment import Environment
    from quadjax.core.errors import InputError
    from quadjax.core.resources import preset_names as presets
    from quadjax.core.sections import Section
    from quadjax.evaluation.evaluation import Evaluation, evaluate
    from quadjax.export.convert import export_c
    from quadjax.learners.ppo.hyperparameters import PPO
    from quadjax.learners.section import LearnerSection, Network, Schedule
    from quadjax.learners.shac.hyperparameters import SHAC
    from quadjax.learners.state import Learner, TrainState
    from quadjax.learners.train import TrainResult
    from quadjax.policy.file import Policy
    from quadjax.race.context import StepContext
    from quadjax.race.layout import Field, Layout, View
    from quadjax.training.result import Run
    from quadjax.training.run import train
    from quadjax.vehicle.protocol import Measurement, Motion, Signal, VehicleModel, VehicleParams

_PUBLIC = {  # name: "module:object"
    "load": "quadjax.config.loading:load_config",
    "presets": "quadjax.core.resources:preset_names",
    "Config": "quadjax.config.schema:Config",
    "Schedule": "quadjax.learners.section:Schedule",
    "make_race": "quadjax.config.race:make_race",
    "train": "quadjax.training.run:train",
    "Run": "quadjax.training.result:Run",
    "evaluate": "quadjax.evaluation.evaluation:evaluate",
    "Evaluation": "quadjax.evaluation.evaluation:Evaluation",
    "Policy": "quadjax.policy.file:Policy",
    "export_c": "quadjax.export.convert:export_c",
    "PPO": "quadjax.learners.ppo.hyperparameters:PPO",
    "SHAC": "quadjax.learners.shac.hyperparameters:SHAC",
    "Network": "quadjax.learners.section:Network",
    "TrainResult": "quadjax.learners.train:TrainResult",
    "LearnerSection": "quadjax.learners.section:LearnerSection",
    "Learner": "quadjax.learners.state:Learner",
    "TrainState": "quadjax.learners.state:TrainState",
    "Environment": "quadjax.core.environment:Environment",
    "VehicleModel": "quadjax.vehicle.protocol:VehicleModel",
    "VehicleParams": "quadjax.vehicle.protocol:VehicleParams",
    "Signal": "quadjax.vehicle.protocol:Signal",
    "Motion": "quadjax.vehicle.protocol:Motion",
    "Measurement": "quadjax.vehicle.protocol:Measurement",
    "StepContext": "quadjax.race.context:StepContext",
    "View": "quadjax.race.layout:View",
    "Field": "quadjax.race.layout:Field",
    "Layout": "quadjax.race.layout:Layout",
    "Section": "quadjax.core.sections:Section",
    "InputError": "quadjax.core.errors:InputError",
}

__all__ = [
    "Config",
    "Environment",
    "Evaluation",
    "Field",
    "InputError",
    "Layout",
    "Learner",
    "LearnerSection",
    "Measurement",
    "Motion",
    "Network",
    "PPO",
    "Policy",
    "Run",
    "SHAC",
    "Schedule",
    "Section",
    "Signal",
    "StepContext",
    "TrainResult",
    "TrainState",
    "VehicleModel",
    "VehicleParams",
    "View",
    "__version__",
    "evaluate",
    "export_c",
    "load",
    "make_race",
    "presets",
    "train",
]


def __getattr__(name: str) -> Any:
    """A public name, imported now (PEP 562)."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _PUBLIC[name].partition(":")
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)
