"""The queue of trials in Optuna's study: every trial once, nothing lost."""

import traceback

import pytest

from quadjax.core.errors import InputError
from quadjax.sweeps.study import JOURNAL, Retry, State, count, open_study
from quadjax.sweeps.sweep import load_sweep
from tests.commands import run
from tests.sweeps.stand_in import CLIP, RATE, complete, finish, open_small, sweep_file


def test_random_parameters_do_not_depend_on_the_order_of_the_trials(tmp_path):
    def drawn(name, order):
        sweep, _, study = open_small(tmp_path / name)
        trials = [study.ask() for _ in range(4)]
        for index in order:
            study.tell(trials[index], sum(sweep.suggest(trials[index]).values()))
        return [trial.params for trial in complete(study)]

    first = drawn("a", [0, 1, 2, 3])
    assert first == drawn("b", [3, 1, 0, 2])
    assert len({params[RATE] for params in first}) == 4
    assert all(1e-4 <= params[RATE] <= 1e-2 and 0.1 <= params[CLIP] <= 0.3 for params in first)


def test_a_random_search_of_choices_takes_no_point_twice(tmp_path):
    space = {CLIP: {"choices": [0.1, 0.2, 0.3]}, "learner.num_epochs": {"range": [1, 3]}}
    search = {"method": "random", "base_first": True}
    for trials in (4, 9):
        path = sweep_file(tmp_path, space=space, search=search, budget={"trials": trials})
        points = [tuple(params.values()) for params in load_sweep(path).queue()]
        assert points[0] == (0.2, 1) and len(set(points)) == trials
    assert load_sweep(path, ["budget.trials=null"]).trials == 9
    with pytest.raises(InputError, match="budget.trials is 10, .* at most 9"):
        load_sweep(path, ["budget.trials=10"])
    sweep, _, study = open_small(tmp_path / "tpe", space=space, search=search | {"method": "tpe"})
    assert tuple(finish(study, sweep, 1.0).params.values()) == (0.2, 1)


def test_a_killed_command_loses_no_trial_and_a_trial_that_was_given_up_stays_so(tmp_path):
    sweep, directory, study = open_small(tmp_path)
    params = sweep.suggest(study.ask())
    lost, given_up = study.ask(), study.ask()
    study.tell(lost, state=State.FAIL)  # killed before it was queued again
    given_up.set_user_attr("error", "out of memory")
    study.tell(given_up, state=State.FAIL)
    wanted = {State.RUNNING: 1, State.WAITING: 1, State.FAIL: 1}
    assert count(study) == count(open_study(sweep, directory, run=False)) == wanted
    again = open_study(sweep, directory)
    assert count(again) == {State.WAITING: 3, State.FAIL: 1}
    trials = {t.user_attrs["index"]: t for t in (finish(again, sweep) for _ in range(3))}
    assert sorted(trials) == [0, 1, 3] and trials[0].params == params
    assert count(open_study(sweep, directory)) == {State.COMPLETE: 3, State.FAIL: 1}
    Retry()(again, again.trials[0])  # of another machine: the value counts, whatever comes later
    assert count(again) == {State.COMPLETE: 3, State.FAIL: 1}


def test_a_line_without_an_end_is_dropped_and_other_damage_is_one_line(tmp_path):
    sweep, directory, study = open_small(tmp_path)
    finish(study, sweep)
    journal = directory / JOURNAL
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code": 6, "tri')
    again = open_study(sweep, directory)
    assert count(again)[State.COMPLETE] == 1
    finish(again, sweep)
    assert count(open_study(sweep, directory))[State.COMPLETE] == 2
    lines = whole.splitlines(keepends=True)
    damages = [
        b"\x00\xff\n".join(lines),
        b"".join([lines[0], b"{}\n", *lines[1:]]),
        b"[]\n" + whole,
        b"".join([lines[0][:-9], *lines[1:]]),
    ]
    for damage in damages:
        journal.write_bytes(damage)
        with pytest.raises(InputError, match=r"study.journal is damaged.*--overwrite") as caught:
            open_study(sweep, directory)
        assert "\n" not in str(caught.value)


def test_a_study_takes_only_its_own_sweep_and_its_budget_only_grows(tmp_path):
    open_small(tmp_path)
    assert count(open_small(tmp_path, "budget.trials=6")[2]) == {State.WAITING: 6}
    for change, message in (
        ("objective.seeds=2", r"objective.seeds was 1, is 2"),
        (f"space.{CLIP}.range=[0.1,0.4]", r"space.learner.clip_range was .*0.3.* is .*0.4"),
        ("overrides.learner.discount=0.9", r"config.*discount was 0.99.*, is 0.9"),
        ("budget.trials=4", "holds 6 trials, budget.trials is 4"),
    ):
        with pytest.raises(InputError, match=message):
            open_small(tmp_path, "budget.trials=6", change)


PASSWORDS = {  # storage, and the forms of the password
    "in the URL": ("postgresql://me:s3cret@127.0.0.1:9/none", "s3cret"),
    "percent-encoded": ("postgresql://me:s3%40cr%2Fet@127.0.0.1:9/none", "s3%40cr%2Fet s3@cr/et"),
    "a parameter": ("postgresql://me@127.0.0.1:9/none?password=s3cret", "s3cret"),
    "an encoded parameter": ("postgresql://me@127.0.0.1:9/a?password=s3%26cr+et", "s3%26cr s3&cr"),
    "a misspelled parameter": ("postgresql://me@127.0.0.1:9/none?passwort=s3cret", "s3cret"),
    "no such port": ("postgresql://me:s3cret@127.0.0.1:port/none", "s3cret"),
    "an at sign": ("postgresql://me:s3@cret@127.0.0.1:9/none", "s3@ cret"),
    "a slash": ("postgresql://me:s3/cret@127.0.0.1:9/none", "s3 cret"),
    "a number sign": ("postgresql://me:s3#cret@127.0.0.1:9/none", "s3 cret"),
    "a question mark": ("postgresql://me:12345?cret@127.0.0.1:9/none", "12345 cret"),
    "an at sign in a parameter": ("postgresql://me@127.0.0.1/none?password=s3@cret", "s3 cret"),
    "a DSN": ("host=127.0.0.1 user=me password=s3cret", "s3cret"),
    "a quoted DSN": ("host=127.0.0.1 password='s3 cret'", "s3 cret"),
    "another database": ("mysql://me:s3cret@host/none", "s3cret"),
}


@pytest.mark.parametrize("form", PASSWORDS)
def test_a_password_is_never_shown(tmp_path, capfd, monkeypatch, form):
    """In no error, traceback or file, also of Optuna, SQLAlchemy and the driver."""
    pytest.importorskip("psycopg", reason="the PostgreSQL driver is not installed")
    url, secrets = PASSWORDS[form]
    path, output = sweep_file(tmp_path, storage=url), tmp_path / "out"
    assert run("sweep", path, "--output", output) == 2
    shown = capfd.readouterr()
    assert shown.err.startswith("error: ") and "storage" in shown.err
    assert shown.err.count("\n") == 1
    monkeypatch.setenv("QUADJAX_DEBUG", "1")
    with pytest.raises(InputError) as caught:
        open_study(load_sweep(path), output)
    text = "".join(traceback.format_exception(caught.value)) + "".join(map(str, shown))
    text += "".join(p.read_text() for p in output.rglob("*") if p.is_file())
    assert not [secret for secret in secrets.split() if secret in text]
