"""Lower bounds of the time of a flight."""

import math

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.limits.bound import Course, PointMass, maximize
from quadjax.limits.intervals import gravity, largest_force
from quadjax.limits.problem import make_problem

FREE = PointMass(force=10.0, drag=1e-3, gravity=np.zeros(3), speed=100.0)


def _point(*place):
    return np.array([place])


def test_a_straight_line_from_rest_to_rest():
    places = (np.tile(_point(x, 0.0, 0.0), (4, 1)) for x in (5.0, 8.0))  # as of squares
    course = Course(tuple(places), start=np.zeros(3), stops=True)
    exact = 2.0 * math.sqrt(8.0 / 10.0)
    found, _ = maximize(course, FREE, longest=10.0)
    assert 0.99 * exact < found <= exact * 1.001  # the relaxation has a little drag


def test_a_circle():
    angles = 2.0 * np.pi * np.arange(12) / 12
    course = Course(tuple(_point(2.0 * math.cos(a), 2.0 * math.sin(a), 0.0) for a in angles))
    exact = 2.0 * math.pi * math.sqrt(2.0 / 10.0)
    found, _ = maximize(course, FREE, longest=10.0)
    assert 0.99 * exact < found <= exact * 1.001


def _square(x: float):
    return np.array([[x, y, z] for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def test_openings_that_touch_have_no_lower_bound():
    """A leg between them may be shorter than any duration that the bound is evaluated for."""
    with pytest.raises(InputError, match="leg 2 begins in an opening that touches the next one"):
        maximize(Course((_square(4.0), _square(4.0)), start=np.zeros(3)), FREE, longest=10.0)
    near = Course((_square(4.0), _square(4.5)), start=np.zeros(3), stops=True)
    found, _ = maximize(near, FREE, longest=10.0)
    exact = 2.0 * math.sqrt(4.5 / 10.0)
    assert 0.98 * exact < found <= exact * 1.001


@pytest.mark.parametrize(
    "words",
    [
        ("e2e_shac",),
        ("indi",),
        pytest.param(("e2e_fastest", "vehicle=5inch"), marks=pytest.mark.slow),
        pytest.param(("e2e_fastest", "vehicle=a2rl"), marks=pytest.mark.slow),
    ],
)
def test_no_sampled_force_exceeds_the_largest(words):
    choices, params = race_of(load_config(words[0], list(words[1:])))
    problem = make_problem(choices.model, params)
    speed, drag = 6.0, 1.0
    largest = largest_force(problem, speed, drag)
    low, high = (np.array(list(map(float, _flat(end)))) for end in _actuators(problem))
    rng = np.random.default_rng(0)
    velocity = rng.normal(size=(200, 3))
    velocity *= speed / np.linalg.norm(velocity, axis=1, keepdims=True)
    values = np.tile(problem.hover_at(*np.zeros((3, 3))), (200, 1))
    moving = problem.hover_at(np.zeros(3), np.ones(3), np.zeros(3)) != values[0]
    assert moving.sum() == 3
    values[:, moving] = velocity
    values[:, problem.actuator_leaves] = np.where(rng.random((200, len(low))) < 0.9, high, low)

    @jax.jit
    @jax.vmap
    def force(values, velocity):
        state = problem.state(values)
        felt = problem.model.specific_force(problem.vehicle, state) + Vec3.of(velocity) * drag
        return felt.array()

    found = np.linalg.norm(force(np.float32(values), np.float32(velocity)), axis=1).max()
    assert 0.9 * largest < found <= largest


@pytest.mark.parametrize("words", [(), ("vehicle=cpc",)])
def test_gravity_of_a_model(words):
    choices, params = race_of(load_config("e2e_fastest", list(words)))
    np.testing.assert_allclose(
        gravity(make_problem(choices.model, params)), [0.0, 0.0, 9.81], atol=1e-5
    )


def _actuators(problem):
    return problem.model.actuator_range(problem.vehicle.constants)


def _flat(end):
    return end.components() if hasattr(end, "components") else [end]
