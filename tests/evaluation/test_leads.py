"""Leads of one contender over another: means by hand, and intervals that contain the truth."""

import numpy as np
import pytest

from quadjax.evaluation.leads import Interval, leads, totals, twice_the_mean

NAN = float("nan")


def flights(*drones):
    """Flights (drones, trainings, flights, laps) of these total times, in two equal laps."""
    return np.array(drones, float)[..., None] * [0.5, 0.5]


def test_times_are_of_pairs_that_both_finish_and_the_score_of_all_flights():
    e2e = np.array([[[[2.0, 2.0], [3.0, 3.0], [2.0, NAN]]]])
    indi = np.array([[[[2.5, 3.0], [2.0, NAN], [3.0, 3.0]]]])
    found = leads(e2e, indi, failed_after=10.0)
    assert (found.pairs, found.of) == (1, 3)
    assert [x.mean for x in found.laps] == [0.5, 1.0] and found.later.mean == 1.0
    assert found.total.mean == found.drones[0].mean == 1.5
    assert found.scores == pytest.approx(((4 + 6 + 10) / 3, (5.5 + 10 + 6) / 3))
    assert found.score.mean == pytest.approx(0.5)
    assert totals(e2e, 10.0).tolist() == [[[4.0, 6.0, 10.0]]]
    assert twice_the_mean(e2e, indi) == pytest.approx(2 * (4 + 6 + 5.5 + 6) / 4)


def test_each_drone_counts_as_one_and_each_pair_of_trainings_on_it():
    """On the second drone the fast training of E2E finishes one flight of two."""
    e2e = flights([[10, 10], [12, 12]], [[10, NAN], [14, 14]])
    indi = flights([[13, 13]], [[15, 17]])
    found = leads(e2e, indi, failed_after=20.0)
    assert [x.mean for x in found.drones] == pytest.approx([2.0, (5 + 1 + 3) / 3])
    assert found.total.mean == pytest.approx(2.5) and (found.pairs, found.of) == (7, 8)
    assert found.score.mean == pytest.approx((13 + 13 + 15 + 17) / 4 - (22 + 22 + 24 + 34) / 8)
    assert found.over == "2 drones, 2 and 1 trainings, flights"


def test_a_drone_without_a_pair_does_not_count():
    found = leads(flights([[10, 10]], [[NAN, 9]]), flights([[11, 13]], [[14, NAN]]), 30.0)
    assert found.total.mean == 2.0 and np.isnan(found.drones[1].mean)
    assert str(found.drones[1]) == "-"
    none = leads(flights([[NAN]]), flights([[12]]), 30.0)
    assert np.isnan(none.total.mean) and none.score.mean == -18.0
    assert np.isnan(twice_the_mean(flights([[NAN]])))


def test_one_fewer_than_there_are_is_drawn():
    """Of two drones with leads of 1 and 3 s one; a single flight has no interval."""
    found = leads(flights([[10]], [[10]]), flights([[11]], [[13]]), 30.0)
    assert found.total == Interval(2.0, 1.0, 3.0) and str(found.total) == "+2.00 [+1.00, +3.00]"
    assert found.over == "2 drones; one training each" and str(found.drones[0]) == "+1.00"
    alone = leads(flights([[10]]), flights([[11]]), 30.0)
    assert np.isnan(alone.total.low) and alone.over == "nothing; one training each"


def test_the_same_seed_draws_the_same():
    random = np.random.default_rng(0)
    pair = random.normal(16, 1, (2, 5, 2, 3, 4))
    first, again, other = (leads(*pair, 30.0, resamples=50, seed=seed) for seed in (0, 0, 1))
    assert first == again and first.total.mean == other.total.mean
    assert first.total.low != other.total.low


@pytest.mark.parametrize(("trainings", "own"), [(1, False), (5, False), (5, True)])
def test_intervals_contain_the_lead_in_about_95_percent_of_experiments(trainings, own):
    """Drones, trainings and flights vary; a lead of 1 s on 8 drones of 4 flights.

    Trainings are those of all drones, or each drone has its own.
    """
    between = 0.3 * (trainings > 1)
    covered = 0
    for seed in range(200):
        random = np.random.default_rng(seed)

        def contender(mean, drones, random=random):
            of_training = between * random.normal(size=(8 if own else 1, trainings, 1))
            noise = 0.2 * random.normal(size=(8, trainings, 4))
            return (mean + drones + of_training + noise)[..., None]

        shared, lead = random.normal(size=(8, 1, 1)), 0.3 * random.normal(size=(8, 1, 1))
        pair = contender(16.0, shared), contender(17.0, shared + lead)
        total = leads(*pair, 34.0, resamples=200, seed=seed, own=own).total
        covered += total.low <= 1.0 <= total.high
    assert 0.88 <= covered / 200 <= 0.99, covered
