"""The queue of trials: one worker for each, nothing lost, nothing done twice."""

import dataclasses
import os
import subprocess
import threading

import pytest

from quadjax.core.errors import InputError
from quadjax.sweeps import locks, store
from quadjax.sweeps.search import JOURNAL_NAME
from quadjax.sweeps.store import State, Store
from tests.sweeps.support import open_store, sweep_file, value_of

ME = locks.this_worker()


def gone() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen(["true"])
    process.wait()
    return process.pid


def dead_worker(session: int | None = None) -> locks.Worker:
    """A worker of this machine that is no more."""
    return dataclasses.replace(locks.this_worker(session), pid=gone(), began="1")


def states(opened: Store) -> list[State]:
    return [trial.state for trial in opened.trials()]


def test_a_trial_is_run_by_one_worker_alone(tmp_path):
    """Four threads with stores of their own empty one queue."""
    first = open_store(tmp_path, "budget.trials=16")
    taken, lock = [], threading.Lock()

    def work():
        own = Store(first.sweep, first.directory)
        while (claim := own.claim(ME)) is not None:
            with lock:
                taken.append((claim.slot, tuple(claim.params.values())))
            own.finish(claim, value_of(claim.params))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(slot for slot, _ in taken) == list(range(16))
    assert len({params for _, params in taken}) == 16
    assert first.counts() == store.Counts(16, 0, 0, 0, min(t.value for t in first.trials()))


def test_parameters_do_not_depend_on_who_draws_them(tmp_path):
    def params(name, workers):
        opened = [open_store(tmp_path / name) for _ in range(workers)]
        found = {}
        for index in range(4):
            claim = opened[index % workers].claim(ME)
            found[claim.slot] = claim.params
        return found

    assert params("alone", 1) == params("together", 2)


def test_tpe_and_grid_find_what_they_should(tmp_path):
    opened = open_store(tmp_path / "tpe", "budget.trials=30", search={"method": "tpe"})
    values = []
    while (claim := opened.claim(ME)) is not None:
        values.append(value_of(claim.params))
        opened.finish(claim, values[-1])
    assert sum(values[-10:]) < sum(values[:10])
    space = {"ppo.clip": {"choices": [0.1, 0.2]}, "ppo.epochs": {"range": [1, 3]}}
    grid = open_store(tmp_path / "g", search={"method": "grid"}, space=space, budget={})
    points = []
    while (claim := grid.claim(ME)) is not None:
        points.append((claim.params["ppo.clip"], claim.params["ppo.epochs"]))
        grid.finish(claim, 1.0)
    assert sorted(points) == [(c, e) for c in (0.1, 0.2) for e in (1, 2, 3)]


@pytest.mark.parametrize("method", ["random", "grid"])
def test_a_dead_workers_trial_fails_and_is_tried_once_more(tmp_path, method):
    space = {"ppo.clip": {"choices": [0.1, 0.2]}}
    opened = open_store(tmp_path, search={"method": method}, space=space, budget={"trials": 2})
    first = opened.claim(dead_worker())
    counts = opened.tend()
    assert (counts.waiting, counts.running, counts.failed) == (2, 0, 0)
    assert opened.trials()[0].state == State.FAIL
    assert opened.trials()[0].user_attrs["error"] == "worker died"
    assert opened.tend() == counts  # once, however often somebody looks
    other = opened.claim(ME)
    again = opened.claim(dead_worker())
    assert {other.slot, again.slot} == {0, 1}
    assert again.slot == first.slot and again.params == first.params and again.attempt == 1
    opened.finish(other, 1.0)
    counts = opened.tend()
    assert (counts.done, counts.open, counts.failed) == (1, 0, 1)
    assert opened.claim(ME) is None


def test_the_base_may_come_first(tmp_path):
    choice = {"choices": [[8], [9]]}
    space = {"ppo.clip": {"range": [0.1, 0.3]}, "network.hidden": choice}
    opened = open_store(tmp_path, "search.base_first=true", space=space)
    base = {"ppo.clip": 0.2, "network.hidden": "[8]"}
    assert opened.claim(dead_worker()).params == base
    claims = [opened.claim(ME) for _ in range(3)]
    assert all(claim.params != base for claim in claims)
    opened.tend()
    again = opened.claim(ME)
    assert again.slot == 0 and again.attempt == 1 and again.params == base


def test_a_trial_that_was_stopped_with_its_sweep_is_not_counted_as_tried(tmp_path):
    opened = open_store(tmp_path, "budget.trials=1")
    for _ in range(3):
        claim = opened.claim(dead_worker(session=gone()))
        assert claim.attempt == 0
        assert opened.tend().waiting == 1
    claim = opened.claim(ME)
    opened.hand_back(claim)
    claim = opened.claim(ME)
    assert claim.attempt == 0
    assert opened.finish(claim, 1.0)
    assert opened.tend().done == 1


def test_a_claim_that_was_never_signed_comes_back(tmp_path):
    """A worker killed between taking a trial and saying who it is."""
    opened = open_store(tmp_path, "budget.trials=1")
    opened.storage.set_trial_state_values(0, State.RUNNING)
    assert opened.tend().waiting == 1


def test_a_claim_cut_short_draws_the_same_again(tmp_path, monkeypatch):
    """A worker killed between the first parameter and the second."""
    wanted = open_store(tmp_path / "whole", "budget.trials=1").claim(ME).params
    opened = open_store(tmp_path / "cut", "budget.trials=1")
    drawn = store.suggest
    monkeypatch.setattr(store, "suggest", lambda trial, dimensions: drawn(trial, dimensions[:1]))
    opened.claim(dead_worker())
    monkeypatch.undo()
    opened.tend()
    again = opened.claim(ME)
    assert again.attempt == 1 and again.params == wanted


def test_a_silent_worker_elsewhere_is_dead_after_a_while(tmp_path, monkeypatch):
    opened = open_store(tmp_path, "budget.trials=1")
    claim = opened.claim(dataclasses.replace(ME, machine="elsewhere"))
    now = [0.0]
    monkeypatch.setattr(store.time, "monotonic", lambda: now[0])
    for now[0] in (0.0, 80.0, 89.0):
        assert opened.tend().running == 1
    opened.beat(claim)
    for now[0] in (91.0, 170.0):
        assert opened.tend().running == 1
    now[0] = 190.0
    assert opened.tend().waiting == 1
    assert not opened.finish(claim, 1.0)  # too late: its slot is somebody else's


def test_killed_between_the_next_attempt_and_the_failure(tmp_path):
    """The slot then has two trials; one is dropped."""
    opened = open_store(tmp_path, "budget.trials=1")
    opened.claim(dead_worker())
    opened._queue(0, 1)
    counts = opened.tend()
    assert (counts.waiting, counts.running) == (1, 0)
    assert states(opened) == [State.FAIL, State.WAITING]


def test_a_journal_that_was_cut_short_is_mended(tmp_path):
    opened = open_store(tmp_path)
    claim = opened.claim(ME)
    opened.finish(claim, 1.0)
    journal = opened.directory / JOURNAL_NAME
    with open(journal, "ab") as stream:
        stream.write(b'{"op_code": 6, "tri')
    again = Store(opened.sweep, opened.directory)
    assert again.counts().done == 1
    again.finish(again.claim(ME), 2.0)
    assert Store(opened.sweep, opened.directory).counts().done == 2


def test_a_lock_goes_with_the_process_that_held_it(tmp_path):
    lock = locks.FileLock(tmp_path / "lock")
    with lock:
        pid = os.fork()
        if pid == 0:
            os._exit(0)
        os.waitpid(pid, 0)
    with locks.FileLock(tmp_path / "lock"):
        pass


def test_a_study_takes_only_its_own_sweep(tmp_path):
    opened = open_store(tmp_path)
    with pytest.raises(InputError, match="objective.seeds was 1, is 2"):
        open_store(tmp_path, objective={"seeds": 2, "flights": 2})
    with pytest.raises(InputError, match="space.ppo.clip"):
        open_store(tmp_path, "space.ppo.clip.range=[0.1,0.4]")
    with pytest.raises(InputError, match="the config said .*0.99.*says .*0.9"):
        open_store(tmp_path, "overrides.ppo.discount=0.9")
    assert opened.counts().waiting == 4


def test_a_budget_may_grow(tmp_path):
    from quadjax.sweeps.run import check_budget

    opened = open_store(tmp_path)
    grown = open_store(tmp_path, "budget.trials=6")
    assert grown.counts().waiting == 6
    with pytest.raises(InputError, match="holds 6 trials, budget.trials is 4"):
        check_budget(opened.sweep, opened.counts())
    assert sweep_file(tmp_path).exists()
