"""The public interface: ``quadjax/__init__.py`` imports these names when they are first used."""

from quadjax.config.assembly import make_race as make_race
from quadjax.config.loading import load as load
from quadjax.config.schema import Config as Config
from quadjax.core.environment import Environment as Environment
from quadjax.core.errors import InputError as InputError
from quadjax.core.resources import presets as presets
from quadjax.core.sections import Section as Section
from quadjax.core.vectors import safe_norm as safe_norm
from quadjax.evaluation.conditions import Condition as Condition
from quadjax.evaluation.curves import training_figure as training_figure
from quadjax.evaluation.evaluate import Evaluation as Evaluation
from quadjax.evaluation.evaluate import evaluate as evaluate
from quadjax.evaluation.report import Report as Report
from quadjax.export.convert import export_c as export_c
from quadjax.fitting.config import LogsConfig as LogsConfig
from quadjax.fitting.flight_log import read_log as read_log
from quadjax.fitting.formats import LogFormat as LogFormat
from quadjax.learners.networks import ActorCritic as ActorCritic
from quadjax.learners.ppo import PPO as PPO
from quadjax.learners.schedules import Schedule as Schedule
from quadjax.learners.section import LearnerSection as LearnerSection
from quadjax.learners.section import Network as Network
from quadjax.learners.section import TrainResult as TrainResult
from quadjax.learners.shac import SHAC as SHAC
from quadjax.learners.state import Learner as Learner
from quadjax.learners.state import TrainState as TrainState
from quadjax.policy.file import Policy as Policy
from quadjax.race.layout import Field as Field
from quadjax.race.layout import Layout as Layout
from quadjax.race.types import Step as Step
from quadjax.sil import message as sil_message
from quadjax.training.result import Run as Run
from quadjax.training.run import train as train
from quadjax.vehicle.constants import constant as constant
from quadjax.vehicle.protocol import Measurement as Measurement
from quadjax.vehicle.protocol import Motion as Motion
from quadjax.vehicle.protocol import Signal as Signal
from quadjax.vehicle.protocol import VehicleModel as VehicleModel
from quadjax.vehicle.protocol import VehicleParams as VehicleParams
from quadjax.vehicle.rate import Rate as RateModel
from quadjax.vehicle.rate import RateConstants as RateConstants

__version__: str
