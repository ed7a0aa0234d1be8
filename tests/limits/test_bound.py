"""Lower bounds of the time of a flight."""

import math

import jax
import numpy as np
import pytest

from quadjax.config.assembly import race_of
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.limits.bound import PointMass, largest_force, lower_bound, make_course, maximize
from quadjax.limits.problem import ACTUATORS, ATTITUDE, VELOCITY, make_problem, numbers
from tests.promotion import QUICK

FREE = PointMass(force=10.0, drag=1e-3, gravity=np.zeros(3), speed=100.0)
ANGLES = 2.0 * np.pi * np.arange(12) / 12


def _square(x: float):
    return np.array([[x, y, z] for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def _line(*places, width=0.0):
    """Openings along a line from rest to rest."""
    openings = tuple(_square(0.0) * width + [x, 0.0, 0.0] for x in places)
    return make_course(openings, start=np.zeros(3), stops=True)


def _circle():
    return make_course(tuple(2.0 * np.array([[math.cos(a), math.sin(a), 0.0]]) for a in ANGLES))


EXACT = {  # a course of a point mass, its shortest time, and how close the bound comes
    "line": (_line(5.0, 8.0), 2.0 * math.sqrt(8.0 / 10.0), 0.99),
    "openings that nearly touch": (_line(4.0, 4.5, width=1.0), 2.0 * math.sqrt(4.5 / 10.0), 0.98),
    "circle": (_circle(), 2.0 * math.pi * math.sqrt(2.0 / 10.0), 0.99),
}


@pytest.mark.parametrize("name", EXACT)
def test_the_bound_of_a_point_mass(name):
    course, exact, tightness = EXACT[name]
    bound, _ = maximize(course, FREE, longest=10.0)
    assert tightness * exact < bound <= exact * 1.001  # the relaxation has a little drag


def test_openings_that_touch_have_no_lower_bound():
    """A leg between them may be shorter than any duration that the bound is evaluated for."""
    course = make_course((_square(4.0), _square(4.0)), start=np.zeros(3))
    with pytest.raises(InputError, match="leg 2 begins in an opening that touches the next one"):
        maximize(course, FREE, longest=10.0)


@pytest.mark.parametrize(
    "words",
    [
        ("e2e",),
        ("indi +fastest",),
        *(("e2e_race", f"vehicle={name}") for name in ("5inch", "a2rl", "cpc")),
    ],
)
def test_no_sampled_force_exceeds_the_largest(words):
    problem = make_problem(*race_of(load_config(words[0], list(words[1:]))))
    speed, drag, rng = 6.0, 1.0, np.random.default_rng(0)
    constants = {name: x for name, x in vars(problem.params.vehicle.constants).items()}
    largest = largest_force(problem.model.name, constants, speed, drag)
    ends = problem.model.actuator_range(problem.params.vehicle.constants)
    low, high = (numbers(end) for end in ends)
    velocity = rng.normal(size=(300, 3))
    velocity *= speed / np.linalg.norm(velocity, axis=1, keepdims=True)
    states = np.tile(problem.start, (300, 1))
    states[:, ATTITUDE], states[:, VELOCITY] = [1.0, 0.0, 0.0, 0.0], velocity
    states[:, ACTUATORS] = np.where(rng.random((300, len(low))) < 0.9, high, low)

    def force(state, velocity):
        felt = problem.model.specific_force(problem.params.vehicle, problem.state(state))
        return (felt + Vec3.of(velocity) * drag).array()

    with jax.enable_x64(True):
        forces = jax.jit(jax.vmap(force), compiler_options=QUICK)(states, velocity)
    found = np.linalg.norm(forces, axis=1).max()
    assert 0.9 * largest < found <= largest


def test_a_residual_has_no_lower_bound():
    bound = lower_bound(make_problem(*race_of(load_config("e2e +residual"))), 10.0, 3.0)
    assert bound.time is None and "no bound" in bound.error
