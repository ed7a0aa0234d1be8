"""Every Python and shell block of the README and of the user guide is run, with short trainings.

The trainings of the quickstart run; those of the other pages leave the policy as it begins, write
no checkpoint, and end without a lap table: their race is traced. Trials of a sweep train nothing.
``fit`` and ``limit`` read their arguments and files only, as ``verify`` does on all pages but one,
and ``compare`` flies nothing: ``tests/evaluation`` and ``tests/surface`` run them. Flights of
exported C end early. The blocks of a page run in order in one folder. Python blocks share a
namespace; a block with a title is written to a file of that name; shell blocks consist of
``quadjax`` commands.
"""

import dataclasses
import importlib
import re
import shlex
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from quadjax.core.resources import CONFIGS, PRETRAINED
from quadjax.evaluation import report, training
from quadjax.evaluation.rows import Row
from quadjax.export import verify as verification
from quadjax.fitting import fit
from quadjax.fitting import report as fit_report
from quadjax.learners import parallel
from quadjax.learners.networks import initial_params
from quadjax.learners.schedules import Training
from quadjax.limits import result as limit
from quadjax.race.laps import Laps
from quadjax.replay import replay
from quadjax.sil import run as sil
from quadjax.sweeps import run as sweeps
from quadjax.training import inputs
from quadjax.training import run as training_run
from quadjax.training.checkpoint import Checkpoints
from tests.commands import run
from tests.docs.pages import GUIDE, ROOT, blocks_of, name_of
from tests.docs.smaller import CODE, WIDE, load_short, short_overrides, smaller
from tests.sil.support import short_drone
from tests.sweeps.stand_in import nothing

compare = importlib.import_module("quadjax.evaluation.compare")  # not the function
NO_LAPS = Laps(np.full((1, 1), np.nan), ("out of time",), np.ones(1), 1.0)
TRAINED = ("docs/getting_started/quickstart.md",)
VERIFIED = ("docs/guide/autopilots.md",)  # pages on which verify runs
OPTIONS = {  # added to a command, unless it has them
    "seeds": ["--seeds", "0", "--runs", "1"],
    "evaluate": ["--runs", "1", "--laps", "1"],  # as view: of one shape, compiled once
    "conditions": ["--runs", "1"],  # of evaluate, too, which have their own laps
    "flights": [],
    "logs": ["--flights", "1", "--laps", "1"],
    "sil": ["--laps", "1"],
    "view": ["--laps", "1"],
    "compare": ["--runs", "2", "--laps", "1", "--drones", "1"],
    "export": ["--allow-unfinished", *(f"--range={name}={size:g}" for name, size in WIDE.items())],
    "verify": ["--allow-unfinished", "--vectors", "100"],
}
SMALLER = [
    *CODE,
    (r"\.export_c\((.*)\)", rf".export_c(\1, allow_unfinished=True, ranges={WIDE})"),
    (r"quadjax\.load\(", "_load("),
]
SHORT_FILE = [  # in the YAML file of a sweep
    (
        r"^overrides:.*$",
        "overrides:\n  learner.num_envs: 16\n  learner.horizon: 4\n"
        "  learner.critic_minibatches: 2\n  run.evaluate_every: 128\n  evaluate.laps: 1",
    ),
    (r"\brun\.steps: \d+", "run.steps: 512"),
    (r"\btrials: \d+", "trials: 2"),
    (r"\bseeds: \d+", "seeds: 1"),
    (r"\bruns: \d+", "runs: 1"),
]
RUN = {"python", "sh"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder, whose modules are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{tmp_path}")  # of the processes of a command
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


INIT = Training.init


def first_state(training, key):
    """As ``Training.init``: the networks, and zeros for all else."""

    def zeros(leaf):
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return jnp.broadcast_to(jax.random.key(0) if is_key else leaf.dtype.type(0), leaf.shape)

    state, task = jax.tree.map(zeros, jax.eval_shape(INIT, training, key)), training.task
    networks = initial_params(task.network, jax.random.key(0), task.environments.observation_size)
    copies = [name for name in ("params", "target", "ema") if getattr(state, name) is not None]
    return dataclasses.replace(state, **dict.fromkeys(copies, networks))


def unchanged(training, mesh, updates, state):
    """As ``parallel.compile_chunk``, of updates that change nothing."""
    return lambda state: (state, {"reward": jnp.zeros(updates)})


def write_fitted(_, folder):
    """As ``fitting.report.write_results``, of a shipped drone."""
    shutil.copy(CONFIGS / "vehicles/bebop1.yaml", folder / "vehicle.yaml")
    shutil.copy(PRETRAINED / "standin_residual.npz", folder / "residual.npz")
    return []


def unflown(*_, **__):
    """As ``evaluate``, of a flight without a lap."""
    return SimpleNamespace(rows=[Row("", NO_LAPS, "sampled, 1 run")])


def in_this_process(command, **options):
    """As ``subprocess.run`` of ``python -m quadjax ARGUMENTS``."""
    assert command[1:3] == ["-m", "quadjax"]
    return SimpleNamespace(returncode=run(*command[3:]))


def train_nothing(monkeypatch):
    """Trainings from here on leave the policy as it begins."""
    monkeypatch.setattr(training_run, "check_functions", inputs.trace_race)
    monkeypatch.setattr(Training, "init", first_state)
    monkeypatch.setattr(parallel, "compile_chunk", unchanged)
    monkeypatch.setattr(Checkpoints, "save", lambda *_: None)
    monkeypatch.setattr(training_run, "make_flights", lambda *_: lambda networks: NO_LAPS)
    monkeypatch.setattr(training, "write_evaluation", lambda run: "")
    monkeypatch.setattr(training, "subprocess", SimpleNamespace(run=in_this_process))
    monkeypatch.setattr(sweeps, "train_and_fly", nothing)


@pytest.mark.slow
@pytest.mark.parametrize("page", GUIDE, ids=name_of)
def test_blocks_run(page, folder, monkeypatch):
    for module in (replay, report):
        monkeypatch.setattr(module, "FORMATS", ("png",))
    monkeypatch.setattr(compare, "evaluate", unflown)
    monkeypatch.setattr(fit, "fit", lambda *_: None)
    for name, stand_in in {"write_results": write_fitted, "write_figures": lambda *_: []}.items():
        monkeypatch.setattr(fit_report, name, stand_in)
    monkeypatch.setattr(fit_report, "tables", lambda _: "")
    monkeypatch.setattr(limit, "best_known", MagicMock())
    if name_of(page) not in TRAINED:
        train_nothing(monkeypatch)
    monkeypatch.setattr(sil, "make_drone", short_drone)
    if name_of(page) not in VERIFIED:
        monkeypatch.setattr(verification, "verify", lambda *_, **__: [])
    namespace: dict[str, object] = {"__name__": "block", "_load": load_short}
    for block in blocks_of(page):
        if block.setup:
            exec(compile(block.setup, f"{page}:{block.line} setup", "exec"), namespace)
        if block.title:
            Path(block.title).write_text(smaller(block.code, SHORT_FILE), encoding="utf-8")
        if block.skipped:
            continue
        if block.language == "python" and not block.title:
            code = compile(smaller(block.code, SMALLER), f"{page}:{block.line}", "exec")
            exec(code, namespace)
        elif block.language == "sh":
            for arguments in commands_of(block.code):
                where = f"{name_of(page)}:{block.line}: {shlex.join(arguments)}"
                assert run(*shortened(arguments)[1:]) == 0, where


def test_blocks_can_be_run():
    """A block is run, or says why not; what is written in YAML can be read."""
    for block in (block for page in GUIDE for block in blocks_of(page)):
        where = f"{name_of(block.page)}:{block.line}"
        assert not block.skipped or block.language in RUN, f"{where}: a skipped {block.language}"
        if block.language == "python":
            compile(block.code, where, "exec")
        elif block.language == "sh" and not block.skipped:
            assert all(arguments[0] == "quadjax" for arguments in commands_of(block.code)), where
        elif block.language == "yaml":
            assert yaml.safe_load(block.code), where
        assert block.language not in {"bash", "shell", "console", "py"}, f"{where}: use sh, python"


def commands_of(code: str) -> list[list[str]]:
    """The arguments of each command but ``source``; lines may continue with a backslash."""
    lines = code.replace("\\\n", " ").splitlines()
    commands = (shlex.split(line, comments=True) for line in lines)
    return [words for words in commands if words and words[0] != "source"]


def test_no_page_trains_a_run_that_another_one_has():
    """Whoever reads on after ``make train`` needs neither --overwrite nor another folder."""
    runs, twice = {"e2e": "make train"}, []
    for page in GUIDE:
        blocks = [block for block in blocks_of(page) if block.language == "sh"]
        named = dict(re.findall(r"title=\"(\S+)\"\n(?:.*\n)*?name: (\S+)", page.read_text("utf-8")))
        for block in (block for block in blocks if not block.skipped):
            for words in commands_of(block.code):
                if words[1] != "train" or {"--resume", "--overwrite", "--seeds"} & {*words}:
                    continue
                parts = [named.get(words[2], words[2]), *(x[1:] for x in words if x[0] == "+")]
                name = words[words.index("--name") + 1] if "--name" in words else "_".join(parts)
                where = f"{name_of(page)}:{block.line}"
                twice += [f"{where}: {name}, as {runs[name]}"] if name in runs else []
                runs.setdefault(name, where)
    assert len(runs) > 20 and not twice


def kind_of(words: list[str]) -> str:
    """The key in ``OPTIONS`` of what a command does."""
    for option in ("seeds", "conditions", "flights"):
        if f"--{option}" in words and words[1] in {"train", "evaluate"}:
            return option
    return "conditions" if words[1] == "evaluate" and words.count("--policy") > 1 else words[1]


def shortened(words: list[str]) -> list[str]:
    """A command with less to do: a short training, few runs."""
    if "--help" in words:
        return words
    result = list(words)
    if words[1] == "train":
        changes = [word for word in words[3:] if "=" in word and not word.startswith("-")]
        short = short_overrides(words[2], changes)
        keys = {change.partition("=")[0] for change in short}
        result = [word for word in result if word.partition("=")[0] not in keys] + short
    extra = OPTIONS.get(kind_of(words), [])
    for option in {word for word in extra if word.startswith("--")} & set(result):
        end = at = result.index(option)
        while end == at or (end < len(result) and not re.search("^-|=", result[end])):
            end += 1
        del result[at:end]
    return result + extra
