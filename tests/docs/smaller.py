"""Code of the pages and the examples with short trainings, all of the shape of ``short.py``."""

import re

import quadjax
from tests.surface.short import OF_EACH, OF_LEARNER

# Untrained policies fly anywhere.
WIDE = {"position": 32.0, "velocity": 64.0, "rates": 1024.0, "next_position": 16.0}
CODE = [  # in Python
    (r"\bsteps=[\d_]+", "steps=512"),
    (r"\.learn\([\d_]+\)", ".learn(512)"),
    (r"\bruns=\d+", "runs=1"),
    (r"\bdrones=\d+", "drones=1"),
    (r"\bflights=\d+, laps=\d+", "flights=2, laps=1"),
    (r"\bnum_envs=\d+", "num_envs=16"),
    (r"\bhorizon=\d+", "horizon=4"),
]
load = quadjax.load


def smaller(text: str, changes: list[tuple[str, str]]) -> str:
    """A text with less to do."""
    for pattern, value in changes:
        text = re.sub(pattern, value, text, flags=re.MULTILINE)
    return text


def short_overrides(name: str, overrides: list[str] | tuple[str, ...] = ()) -> list[str]:
    """The overrides that make a training short; an own learner keeps its hyperparameters."""
    config = load(name, overrides)
    tracks = [] if config.randomization.tracks is None else ["randomization.tracks.count=8"]
    return [*OF_EACH, *OF_LEARNER.get(config.learner.algorithm, ()), *tracks]


def load_short(
    name: str, overrides: list[str] | tuple[str, ...] = (), kept: tuple[str, ...] = ()
) -> quadjax.Config:
    """``quadjax.load`` with the settings of a short training, but for the keys ``kept``."""
    short = short_overrides(name, overrides)
    return load(name, [*overrides, *(x for x in short if x.partition("=")[0] not in kept)])
