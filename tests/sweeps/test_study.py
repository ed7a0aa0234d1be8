"""The queue of trials in Optuna's study: every trial once, nothing lost."""

import traceback

import pytest

from quadjax.core.errors import InputError
from quadjax.sweeps.run import count
from quadjax.sweeps.study import JOURNAL, OVER, Retry, State, open_study
from quadjax.sweeps.sweep import load_sweep
from tests.commands import run
from tests.sweeps.support import CLIP, RATE, complete, finish, open_small, sweep_file


def states(study) -> list[State]:
    return [trial.state for trial in study.get_trials(deepcopy=False)]


def test_random_parameters_do_not_depend_on_the_order_of_the_trials(tmp_path):
    def drawn(name, order):
        sweep, _, study = open_small(tmp_path / name)
        trials = [study.ask() for _ in range(4)]
        for index in order:
            params = {key: sweep.suggest(trials[index], key) for key in sweep.space}
            study.tell(trials[index], sum(params.values()))
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


def test_tpe_gets_better_and_a_grid_has_every_point(tmp_path):
    sweep, _, study = open_small(tmp_path / "tpe", "budget.trials=30", search={"method": "tpe"})
    for _ in range(30):
        finish(study, sweep)
    values = [trial.value for trial in complete(study)]
    assert sum(values[-10:]) < sum(values[:10])

    space = {CLIP: {"choices": [0.1, 0.2]}, "learner.num_epochs": {"range": [1, 3]}}
    sweep, _, study = open_small(tmp_path / "g", search={"method": "grid"}, space=space, budget={})
    points = [tuple(finish(study, sweep, 1.0).params.values()) for _ in range(6)]
    assert sorted(points) == [(clip, epochs) for clip in (0.1, 0.2) for epochs in (1, 2, 3)]


def test_the_base_config_may_be_the_first_trial(tmp_path):
    space = {CLIP: {"range": [0.1, 0.3]}, "network.hidden": {"choices": [[8], [9]]}}
    for method in ("random", "tpe"):
        search = {"method": method, "base_first": True}
        sweep, _, study = open_small(tmp_path / method, search=search, space=space)
        base = {CLIP: 0.2, "network.hidden": "[8]"}
        assert finish(study, sweep, 1.0).params == base
        assert finish(study, sweep, 1.0).params != base


def test_a_trial_of_a_killed_command_is_queued_again_with_its_parameters(tmp_path):
    sweep, directory, study = open_small(tmp_path, "budget.trials=2")
    taken = study.ask()
    params = {key: sweep.suggest(taken, key) for key in sweep.space}
    again = open_study(sweep, directory)
    assert count(again).waiting == 2 and states(again)[0] == State.FAIL
    finish(again, sweep)
    trial = finish(again, sweep)
    assert trial.user_attrs["index"] == 0 and trial.params == params
    assert count(open_study(sweep, directory)).done == 2


def test_a_command_killed_between_failing_and_queueing_a_trial_loses_nothing(tmp_path):
    sweep, directory, study = open_small(tmp_path, "budget.trials=1")
    study.tell(study.ask(), state=State.FAIL)
    assert count(study).waiting == 0
    assert count(open_study(sweep, directory)).waiting == 1


def test_a_trial_that_was_given_up_is_not_queued_again(tmp_path):
    sweep, directory, study = open_small(tmp_path, "budget.trials=1")
    trial = study.ask()
    trial.set_user_attr("error", "out of memory")
    study.tell(trial, state=State.FAIL)
    found = count(open_study(sweep, directory))
    assert (found.failed, found.waiting, found.done) == (1, 0, 0)


def test_a_report_reads_the_study_and_changes_nothing(tmp_path):
    sweep, directory, study = open_small(tmp_path)
    study.ask()
    assert count(open_study(sweep, directory, run=False)).running == 1


def test_a_value_of_a_retried_trial_counts_whatever_comes_later(tmp_path):
    sweep, _, study = open_small(tmp_path, "budget.trials=1")
    finish(study, sweep, 12.0)
    Retry()(study, study.trials[0])
    assert count(study).done == 1 and count(study).best == 12.0 and states(study)[0] in OVER


def test_a_line_without_an_end_is_dropped_and_other_damage_is_one_line(tmp_path):
    sweep, directory, study = open_small(tmp_path)
    finish(study, sweep)
    journal = directory / JOURNAL
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code": 6, "tri')
    again = open_study(sweep, directory)
    assert count(again).done == 1
    finish(again, sweep)
    assert count(open_study(sweep, directory)).done == 2
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


def test_a_study_takes_only_its_own_sweep(tmp_path):
    open_small(tmp_path)
    with pytest.raises(InputError, match=r"objective.seeds was 1, is 2"):
        open_small(tmp_path, objective={"seeds": 2, "runs": 2})
    with pytest.raises(InputError, match=r"space.learner.clip_range was .*0.3.* is .*0.4"):
        open_small(tmp_path, "space.learner.clip_range.range=[0.1,0.4]")
    with pytest.raises(InputError, match=r"config.*discount was 0.99.*, is 0.9"):
        open_small(tmp_path, "overrides.learner.discount=0.9")
    assert count(open_small(tmp_path)[2]).waiting == 4


def test_a_budget_can_grow_and_not_shrink(tmp_path):
    open_small(tmp_path)
    assert count(open_small(tmp_path, "budget.trials=6")[2]).waiting == 6
    with pytest.raises(InputError, match="holds 6 trials, budget.trials is 4"):
        open_small(tmp_path)


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
    assert run("sweep", path, f"storage=[{url}]", "--output", output) == 2
    assert run("sweep", path, f"storage {url}", "--output", output) == 2
    monkeypatch.setenv("QUADJAX_DEBUG", "1")
    with pytest.raises(InputError) as caught:
        open_study(load_sweep(path), output)
    text = "".join(traceback.format_exception(caught.value)) + "".join(map(str, shown))
    text += "".join(map(str, capfd.readouterr()))
    text += "".join(p.read_text() for p in output.rglob("*") if p.is_file())
    assert not [secret for secret in secrets.split() if secret in text]
