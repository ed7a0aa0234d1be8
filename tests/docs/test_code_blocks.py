"""Every Python and shell block of the README and of the user guide is run, with short trainings.

The blocks of a page run in order in one folder. Python blocks share a namespace; a block with a
title is written to a file of that name; shell blocks consist of ``quadjax`` commands.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.docs.pages import GUIDE, ROOT, Block, blocks_of, name_of

SHORT = ["run.steps=1024", "run.evaluate_every=512", "learner.num_envs=16", "network.hidden=[8]"]
SHORT += ["evaluate.laps=1", "run.devices=1"]
SHORT_PPO = ["learner.rollout_length=8", "learner.num_minibatches=2", "learner.num_epochs=1"]
SHORT_SHAC = ["learner.horizon=4", "learner.critic_minibatches=2", "learner.critic_epochs=1"]
TRAINS = ("train", "seeds")
# Untrained policies fly anywhere.
WIDE = {"position": 32.0, "velocity": 64.0, "rates": 1024.0, "next_position": 16.0}
OPTIONS = {  # added to a command, unless it has them
    "seeds": ["--seeds", "0", "1", "--runs", "2"],
    "evaluate": ["--runs", "2", "--laps", "1"],
    "compare": ["--runs", "2", "--laps", "1", "--parts", "table"],
    "export": ["--allow-unfinished", *(f"--range={name}={size:g}" for name, size in WIDE.items())],
    "verify": ["--allow-unfinished", "--vectors", "100"],
    "benchmark": ["--quick", "--repeats", "1"],
}
SMALLER = [  # in Python blocks
    (r"\bsteps=[\d_]+", "steps=1_024"),
    (r"\bruns=\d+", "runs=2"),
    (r"\bnum_envs=\d+", "num_envs=16"),
    (r"\bhorizon=\d+", "horizon=4"),
    (r"\.export_c\((.*)\)", rf".export_c(\1, allow_unfinished=True, ranges={WIDE})"),
]
SHORT_FILE = [  # in the YAML file of a sweep
    (
        r"^overrides:.*$",
        "overrides:\n  learner.num_envs: 16\n  learner.horizon: 4\n"
        "  learner.critic_minibatches: 2\n  run.evaluate_every: 512\n  evaluate.laps: 1",
    ),
    (r"\brun\.steps: \d+", "run.steps: 1024"),
    (r"\btrials: \d+", "trials: 2"),
    (r"\bseeds: \d+", "seeds: 1"),
    (r"\bruns: \d+", "runs: 1"),
]
RUN = {"python", "sh"}
LIMIT = 1200  # s, a command


@pytest.mark.slow
@pytest.mark.parametrize("page", GUIDE, ids=name_of)
def test_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    namespace: dict[str, object] = {"__name__": "block"}
    for block in blocks_of(page):
        if block.setup:
            exec(compile(block.setup, f"{page}:{block.line} setup", "exec"), namespace)
        if block.title:
            Path(block.title).write_text(smaller(block.code, SHORT_FILE), encoding="utf-8")
        if block.skipped:
            continue
        if block.language == "python" and not block.title:
            run_python(block, namespace)
        elif block.language == "sh":
            run_shell(block, tmp_path)


@pytest.mark.parametrize("page", GUIDE, ids=name_of)
def test_blocks_can_be_run(page):
    """A block is run, or says why not; what is written in YAML can be read."""
    for block in blocks_of(page):
        where = f"{name_of(page)}:{block.line}"
        assert not block.skipped or block.language in RUN, f"{where}: a skipped {block.language}"
        if block.language == "python":
            compile(block.code, where, "exec")
        elif block.language == "sh" and not block.skipped:
            assert all(arguments[0] == "quadjax" for arguments in commands_of(block.code)), where
        elif block.language == "yaml":
            assert yaml.safe_load(block.code), where
        assert block.language not in {"bash", "shell", "console", "py"}, f"{where}: use sh, python"


def run_python(block: Block, namespace: dict[str, object]) -> None:
    code = smaller(block.code, SMALLER)
    code = re.sub(r"quadjax\.load\(", "_load(", code)
    namespace["_load"] = load_short
    exec(compile(code, f"{block.page}:{block.line}", "exec"), namespace)


def smaller(text: str, changes: list[tuple[str, str]]) -> str:
    """A text with less to do."""
    for pattern, value in changes:
        text = re.sub(pattern, value, text, flags=re.MULTILINE)
    return text


def load_short(name: str, overrides: list[str] | tuple[str, ...] = ()) -> object:
    """``quadjax.load`` with the settings of a short training."""
    import quadjax

    kind = quadjax.load(name, overrides).learner.algorithm
    return quadjax.load(name, [*overrides, *short(kind)])


def short(kind: str) -> list[str]:
    return SHORT + {"ppo": SHORT_PPO, "shac": SHORT_SHAC}.get(kind, [])


def commands_of(code: str) -> list[list[str]]:
    """The arguments of each command; lines may continue with a backslash."""
    lines = code.replace("\\\n", " ").splitlines()
    return [
        arguments for arguments in (shlex.split(line, comments=True) for line in lines) if arguments
    ]


def run_shell(block: Block, folder: Path) -> None:
    for arguments in commands_of(block.code):
        command = [sys.executable, "-m", *shortened(arguments)]
        done = subprocess.run(
            command,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{folder}"},
            capture_output=True,
            text=True,
            timeout=LIMIT,
        )
        where = f"{name_of(block.page)}:{block.line}"
        assert done.returncode == 0, f"{where}: {shlex.join(arguments)}\n{done.stdout}{done.stderr}"


def shortened(arguments: list[str]) -> list[str]:
    """A command with less to do: a short training, few runs."""
    if "--help" in arguments:
        return arguments
    result = list(arguments)
    if arguments[1] in TRAINS:
        import quadjax

        changes = [w for w in arguments[3:] if "=" in w and not w.startswith("-")]
        kind = quadjax.load(arguments[2], changes).learner.algorithm
        keys = {change.partition("=")[0] for change in short(kind)}
        result = [w for w in result if w.partition("=")[0] not in keys] + short(kind)
    extra = OPTIONS.get(arguments[1], [])
    for option in [w for w in extra if w.startswith("--")]:
        if option in result:
            at = result.index(option)
            end = at + 1
            while end < len(result) and not result[end].startswith("-") and "=" not in result[end]:
                end += 1
            del result[at:end]
    return result + extra
