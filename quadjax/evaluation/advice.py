"""Lines of ``quadjax train``: what to check before a training, and what to run after it."""

import math
from collections.abc import Sequence

from quadjax.config.loading import names_of_code
from quadjax.config.schema import Config
from quadjax.core.errors import quadjax_command
from quadjax.flights.flight import Flight
from quadjax.race.legs import against_text
from quadjax.training.result import Run
from quadjax.vehicle.registry import base_model

ON_PLANT = ("motor", "rate")  # vehicle models whose policies fly on a plant
UNCERTAIN = "e2e_race_robust trains"  # for constants that differ from the model's
UNCERTAIN_RATE = (  # no preset of the model rate draws them
    "indi_race randomization.all=0.2 'reward.gate_edge_margin=0.2 half gates' "
    "rules.body_radius=RADIUS rules.gate_test=interpolated trains"
)


def before_training(config: Config) -> list[str]:
    """Lines on a race that can be trained, but probably is not what is meant."""
    against = against_text(config.track)
    lines = [f"{config.track.name}: {against}" if against else "", wide_margin(config)]
    return [line for line in lines if line]


def wide_margin(config: Config) -> str:
    """A line where the reward's margin is most of what the narrowest opening leaves, or nothing."""
    margin, key = config.reward.gate_edge_margin, "reward.gate_edge_margin"
    half = 0.5 * min(side for gate in config.track.gates for side in gate.size)
    left = half - (config.rules.body_radius or 0.0)
    if not config.reward.gate_edge or margin <= 0.5 * left:
        return ""
    narrow = f"the {left:.3g} m from the center to the edge of the narrowest opening"
    if config.rules.body_radius:
        narrow += ", less rules.body_radius"
    problem = f"most of {narrow}: safe and slow"
    if margin >= left:
        problem = f"cannot be met within {narrow}: a policy may not learn to pass it"
    return (
        f"{key} is {margin:.3g} m, {problem}; {key}={math.floor(500.0 * left) / 1000.0:g} is half"
    )


def look(run: Run) -> str:
    """What to run next where no lap is to be judged."""
    # Code that a policy file names is imported only from a config that the user names.
    code = set(names_of_code(run.config)) - set(run.config.reward.terms)
    race = ("--race", run.folder / "config.yaml") if code else ()
    return f"next: {quadjax_command('view', run.folder, *race)} shows its flight"


def next_step(run: Run, flights: Sequence[Flight]) -> list[str]:
    """The smallest clearance of flights against the drone's width, and what to run next."""
    config = run.config
    half, radius = 0.5 * config.vehicle.width, config.rules.body_radius or 0.0
    near = min((float(x) for flight in flights for x in flight.passages[:, 2]), default=math.inf)
    width = f"half of the drone's width is {half:.2f} m" if half else "vehicle.width is not set"
    lines = [f"smallest clearance of the deterministic flights: {near:.2f} m; {width}"]
    lines = lines if math.isfinite(near) else []
    command = f"next: {quadjax_command('evaluate', '--policy', run.folder)}"
    largest = max(half, radius)
    body = f"{math.ceil(100.0 * largest - 1e-6) / 100.0:g}" if largest else "RADIUS"
    model = base_model(config.vehicle.model).name
    plant = ", or --plant" if model in ON_PLANT else ""
    if near < half or not (half or radius):
        remedy = f"train with rules.body_radius={body} rules.gate_test=interpolated"
        return [*lines, f"{command} --body {body}; {remedy}"]
    if config.randomization.drawn:
        return [*lines, f"{command} --conditions spread{plant}; then quadjax export"]
    uncertain = UNCERTAIN_RATE.replace("RADIUS", body) if model == "rate" else UNCERTAIN
    return [*lines, f"{command} --conditions spread{plant}; {uncertain} for these"]
