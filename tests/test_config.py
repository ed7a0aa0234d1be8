"""Configs: every shipped one loads, and every mistake is one line that says what is allowed."""

import dataclasses
from pathlib import Path

import pytest

from quadjax.config import checks
from quadjax.config.loading import (
    fill,
    load_config,
    merge_trees,
    parse_words,
    to_yaml,
)
from quadjax.config.schema import Config, RewardConfig
from quadjax.core.errors import InputError, command_line
from quadjax.core.resources import CONFIGS
from quadjax.fitting.pipeline import load_fit_config
from tests import reference as ref

SHIPPED = sorted(CONFIGS.glob("*.yaml"))
BLANK = Path(__file__).parent / "blank.yaml"


def refusal(path, *words):
    with pytest.raises(InputError) as caught:
        load_config(path, words)
    text = str(caught.value)
    assert text and "\n" not in text
    return text


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_config_loads_and_comes_back(path, tmp_path):
    config = load_config(path)
    assert config.name == path.stem
    (tmp_path / "config.yaml").write_text(to_yaml(config))
    assert load_config(tmp_path / "config.yaml") == config


@pytest.mark.parametrize("path", sorted((CONFIGS / "tracks").glob("*.yaml")), ids=str)
def test_every_shipped_track_loads(path):
    config = load_config(BLANK, [f"track.file={path.name}"])
    assert config.track.name == path.stem and len(config.track.gates) >= 1


@pytest.mark.parametrize("path", sorted((CONFIGS / "vehicles").glob("*.yaml")), ids=str)
def test_every_shipped_vehicle_loads(path):
    assert load_config(BLANK, [f"vehicle.file={path.name}"]).vehicle.name


def test_paper_presets_weigh_the_reward_as_published():
    for path in SHIPPED:
        if path.stem.endswith("_paper"):
            assert load_config(path).reward == RewardConfig()


def test_defaults_are_the_published_model():
    config = load_config(BLANK)
    assert config.vehicle.motor == ref.MOTOR and config.vehicle.rate == ref.RATE
    assert config.vehicle.mass == 0.389
    assert [gate.position for gate in config.track.gates] == ref.GATES.tolist()
    assert [gate.yaw_deg for gate in config.track.gates] == [45, 135, 225, 315]
    assert all(gate.size == [1, 1] for gate in config.track.gates)
    assert config.start.roll_pitch_deg == 40 and config.start.rates == 1
    assert config.episode.max_steps == 1200 and config.episode.dt == 0.01
    assert config.episode.gate_test == "square"
    assert set(vars(config.randomise).values()) == {0.0}


def test_words_fill_the_config():
    config = load_config(
        BLANK,
        [
            "seed=7",
            "ppo.learning_rate=1e-3",
            "network.hidden=[32, 16]",
            "vehicle.kind=rate",
            "episode.random_gate=true",
            "train.devices=2",
            "name=other",
            "episode.disturbance_input=true",
        ],
    )
    assert config.seed == 7 and config.ppo.learning_rate == 1e-3
    assert config.network.hidden == [32, 16] and config.vehicle.kind == "rate"
    assert config.episode.random_gate is True and config.train.devices == "2"
    assert config.name == "other" and config.episode.disturbance_input == "true"


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "+1.e-3", ".1e-2", "0.001", "1_0e-4"])
def test_numbers_with_exponents_are_numbers(tmp_path, text):
    path = tmp_path / "c.yaml"
    path.write_text(f"ppo:\n  learning_rate: {text}\n")
    assert load_config(path).ppo.learning_rate == pytest.approx(1e-3, rel=1e-12)
    assert parse_words([f"x={text}"])["x"] == pytest.approx(1e-3, rel=1e-12)
    assert parse_words(["x=e-3"])["x"] == "e-3" and parse_words(["x=1.2.3"])["x"] == "1.2.3"


def test_whole_numbers_may_have_an_exponent():
    assert load_config(BLANK, ["train.steps=2e6"]).train.steps == 2_000_000
    assert "train.steps" in refusal(BLANK, "train.steps=2.5")


def test_one_constant_overridden_keeps_the_others():
    config = load_config(BLANK, ["vehicle.motor.k_w=5e-8", "vehicle.rate.d_x=0.5"])
    assert config.vehicle.motor == ref.MOTOR | {"k_w": 5e-8}
    assert config.vehicle.rate == ref.RATE | {"d_x": 0.5}


def test_base_files_lie_under(tmp_path):
    (tmp_path / "a.yaml").write_text("name: a\nseed: 1\nppo:\n  clip: 0.3\n  epochs: 2\n")
    (tmp_path / "b.yaml").write_text("base: a.yaml\nname: b\nppo:\n  epochs: 3\n")
    (tmp_path / "c.yaml").write_text("base: b.yaml\nseed: 2\n")
    config = load_config(tmp_path / "c.yaml", ["ppo.batches=4"])
    assert (config.name, config.seed) == ("b", 2)
    assert (config.ppo.clip, config.ppo.epochs, config.ppo.batches) == (0.3, 3, 4)


def test_a_vehicle_and_a_track_beside_the_config(tmp_path):
    """What was read beside the config comes back from the saved one, wherever that lies."""
    text = (CONFIGS / "vehicles" / "bebop1.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(text.replace("g: 9.81", "g: 9.7"))
    (tmp_path / "hall.yaml").write_text("name: hall\ngates:\n  - {position: [1, 2, -3]}\n")
    path = tmp_path / "c.yaml"
    path.write_text("vehicle:\n  file: mine.yaml\ntrack:\n  file: hall.yaml\n")
    config = load_config(path)
    assert config.vehicle.motor["g"] == 9.7 and len(config.track.gates) == 1
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "config.yaml").write_text(to_yaml(config))
    assert load_config(tmp_path / "runs" / "config.yaml") == config


WRONG_WORDS = [
    # word, what the line must say
    ("sede=1", ["sede", "seed"]),
    ("ppo.rate=1", ["ppo.rate", "learning_rate"]),
    ("vehicle.motor.k_q2=1", ["vehicle.motor.k_q2", "k_qv"]),
    ("algorithm=sac", ["algorithm", "sac", "ppo, shac"]),
    ("vehicle.kind=boat", ["vehicle.kind", "boat", "motor, rate"]),
    ("vehicle.integrator=heun", ["vehicle.integrator", "heun", "euler, rk4"]),
    ("episode.gate_test=round", ["episode.gate_test", "round", "square"]),
    ("episode.disturbance_input=false", ["episode.disturbance_input", "false", "none"]),
    ("network.activation=gelu", ["network.activation", "gelu", "relu"]),
    ("seed=abc", ["seed", "abc"]),
    ("seed=-1", ["seed", "-1"]),
    ("seed=1.5", ["seed", "1.5"]),
    ("seed=null", ["seed"]),
    ("ppo.clip=wide", ["ppo.clip", "wide"]),
    ("ppo.clip=true", ["ppo.clip", "True"]),
    ("ppo.clip=0", ["ppo.clip", "0", "positive"]),
    ("ppo.clip=.nan", ["ppo.clip", "nan"]),
    ("ppo.clip=[1]", ["ppo.clip"]),
    ("ppo.discount=1", ["ppo.discount", "1"]),
    ("ppo.gae_lambda=1.1", ["ppo.gae_lambda", "1.1"]),
    ("shac.final_discount=1", ["shac.final_discount", "1"]),
    ("ppo.epochs=0", ["ppo.epochs", "0", "at least 1"]),
    ("ppo.batches=7", ["ppo.batches", "7", "divisor"]),
    ("ppo.shuffle_block=5", ["ppo.shuffle_block", "5", "divisor"]),
    ("ppo.separate_clip=maybe", ["ppo.separate_clip", "maybe"]),
    ("ppo=3", ["ppo", "3"]),
    ("ppo=null", ["ppo"]),
    ("reward.time=inf", ["reward.time", "inf"]),
    ("reward.time=.inf", ["reward.time", "inf"]),
    ("episode.max_steps=0", ["episode.max_steps", "0"]),
    ("episode.pitch_limit_deg=90", ["episode.pitch_limit_deg", "90", "89"]),
    ("reward.edge=-1", ["reward.edge", "-1"]),
    ("reward.onward=-1", ["reward.onward", "-1"]),
    ("episode.gate_margin=0.5", ["episode.gate_margin", "0.5"]),
    ("start.thrust=[8, 7]", ["start.thrust", "8"]),
    ("start.thrust=[7]", ["start.thrust", "7"]),
    ("start.thrust=7", ["start.thrust"]),
    ("train.residual_ramp=[2, 1]", ["train.residual_ramp", "2"]),
    ("train.residual_ramp=[-1, 1]", ["train.residual_ramp", "-1"]),
    ("train.residual_ramp=[1]", ["train.residual_ramp"]),
    ("train.yaw_ramp=[2, 1]", ["train.yaw_ramp", "2"]),
    ("train.nose_up_price=-1", ["train.nose_up_price", "-1"]),
    ("train.edge_ramp=[2, 1]", ["train.edge_ramp", "2"]),
    ("randomise.drag=1", ["randomise.drag", "1", "0.9"]),
    ("network.hidden=[]", ["network.hidden"]),
    ("network.hidden=[0]", ["network.hidden", "0"]),
    ("network.hidden=64", ["network.hidden"]),
    ("network.hidden=[a]", ["network.hidden", "a"]),
    ("name=a/b", ["name", "a/b"]),
    ("name=..", ["name", ".."]),
    ("name=", ["name"]),
    ("train.devices=none", ["train.devices", "none", "auto"]),
    ("train.devices=0", ["train.devices", "0"]),
    ("track.gates=[]", ["track.gates"]),
    ("track.gates=[1]", ["track.gates", "1"]),
    ("track.gates=3", ["track.gates"]),
    ("track.gates={a: 1}", ["track.gates"]),
    ("track.gates=[{position: [0, 0]}]", ["track.gates[0].position"]),
    ("track.gates=[{position: [0, 0, a]}]", ["track.gates[0].position[2]", "a"]),
    ("track.gates=[{place: [0, 0, 0]}]", ["track.gates[0].place", "position"]),
    ("track.gates=[{position: [0, 0, 0], size: [0, 1]}]", ["track.gates[0].size"]),
    ("track.gates=[{position: [0, 0, 0], yaw_deg: .nan}]", ["track.gates[0].yaw_deg", "nan"]),
    ("track.file=none.yaml", ["none.yaml", "tracks"]),
    ("track.file=3", ["track.file", "3"]),
    ("track=3", ["track", "3"]),
    ("vehicle.file=none.yaml", ["none.yaml", "vehicles"]),
    ("vehicle.motor.k_w=0", ["vehicle.motor.k_w", "0", "positive"]),
    ("vehicle.motor.k_w=heavy", ["k_w", "heavy"]),
    ("vehicle.motor.k_w=null", ["k_w"]),
    ("vehicle.motor.k_x=.inf", ["vehicle.motor.k_x", "inf"]),
    ("vehicle.motor.rpm_min=12000", ["vehicle.motor.rpm_min", "12000", "rpm_max"]),
    ("vehicle.motor=3", ["vehicle.motor", "3"]),
    ("vehicle.motor=[1]", ["vehicle.motor"]),
    ("vehicle.rate.tau_rate=-1", ["vehicle.rate.tau_rate", "-1"]),
    ("vehicle.rate.thrust_min=20", ["vehicle.rate.thrust_min", "20", "thrust_max"]),
    ("vehicle.rate.p_max=0", ["vehicle.rate.p_max", "0", "positive"]),
    ("ppo.clip", ["ppo.clip", "key=value"]),
    ("=3", ["=3", "key=value"]),
    ("ppo..clip=3", ["ppo..clip", "key=value"]),
    ("ppo.clip={", ["ppo.clip"]),
    ("name=???", ["name"]),
    ("name=${nothing}", ["nothing"]),
]


@pytest.mark.parametrize(("word", "says"), WRONG_WORDS, ids=[word for word, _ in WRONG_WORDS])
def test_wrong_words(word, says):
    text = refusal(BLANK, word)
    assert all(part in text for part in says), text


WRONG_FILES = {
    "twice": ("seed: 1\nseed: 2\n", ["seed", "twice", "line 2"]),
    "twice below": ("ppo:\n  clip: 1\n  clip: 2\n", ["clip", "twice", "line 3"]),
    "not a mapping": ("- 1\n- 2\n", ["mapping"]),
    "a word": ("hello\n", ["mapping"]),
    "no yaml": ("seed: [1\n", ["line"]),
    "a tab": ("ppo:\n\tclip: 1\n", ["line 2"]),
    "a list for a key": ("? [1, 2]\n: 3\n", ["line 1"]),
    "a number for a key": ("1: 2\n", ["1"]),
    "unknown": ("seed: 1\nfoo: 2\n", ["foo", "seed"]),
    "unknown below": ("shac:\n  foo: 2\n", ["shac.foo", "horizon"]),
    "a base that is not there": ("base: none.yaml\n", ["none.yaml", "no such file"]),
    "a base that is no name": ("base: 3\n", ["base", "3"]),
    "a base that is itself": ("base: c.yaml\n", ["base", "itself"]),
    "python": ("seed: !!python/object/apply:os.getcwd []\n", ["line 1"]),
    "a date for a seed": ("seed: 2020-01-01\n", ["seed"]),
}


@pytest.mark.parametrize("case", WRONG_FILES)
def test_wrong_files(tmp_path, case):
    text, says = WRONG_FILES[case]
    (tmp_path / "c.yaml").write_text(text)
    found = refusal(tmp_path / "c.yaml")
    assert all(part in found for part in says), found


def test_files_that_cannot_be_read(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.yaml")
    refusal(tmp_path)
    (tmp_path / "c.yaml").write_bytes(b"\xff\xfe\x00seed")
    refusal(tmp_path / "c.yaml")
    (tmp_path / "d.yaml").write_bytes(b"seed: \x00")
    refusal(tmp_path / "d.yaml")


def test_vehicle_files_are_checked(tmp_path):
    text = (CONFIGS / "vehicles" / "bebop1.yaml").read_text()
    path = tmp_path / "mine.yaml"
    (tmp_path / "c.yaml").write_text("vehicle: {file: mine.yaml}\n")
    path.write_text("".join(x for x in text.splitlines(True) if not x.startswith("  k_w")))
    assert "vehicle.motor.k_w is missing" in refusal(tmp_path / "c.yaml")
    path.write_text(text + "colour: red\n")
    found = refusal(tmp_path / "c.yaml")
    assert "colour" in found and "mine.yaml" in found
    path.write_text("motor: 3\n")
    refusal(tmp_path / "c.yaml")
    (tmp_path / "d.yaml").write_text("track: {file: hall.yaml}\n")
    (tmp_path / "hall.yaml").write_text("gate: []\n")
    assert "gate" in refusal(tmp_path / "d.yaml")
    (tmp_path / "hall.yaml").write_text("name: hall\n")
    assert "track.gates" in refusal(tmp_path / "d.yaml")


@pytest.mark.parametrize(
    "word",
    [
        "vehicle.residual=file.npz",
        "disturbance.steady_moment=[0.01,0,0]",
        "randomise.thrust=0.1",
        "episode.disturbance_input=estimated",
    ],
)
def test_what_would_change_nothing_is_refused(word):
    load_config(BLANK, [word])
    assert word.split("=")[0] in refusal(BLANK, "vehicle.kind=rate", word)


@pytest.mark.parametrize(
    "words",
    [
        ["episode.max_steps=3000000000"],
        ["episode.dt=5"],
        ["train.steps=1000000000000000"],
        ["vehicle.motor.rpm_min=-5000"],
        ["vehicle.motor.k_w=[1]"],
        ["randomise.limits=0.9"],
    ],
)
def test_what_is_out_of_all_proportion_is_refused(words):
    assert words[0].split("=")[0] in refusal(BLANK, *words)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["train.yaw_ramp=[0, 2]", "start.yaw_deg=90"], ["train.yaw_ramp", "start.yaw_deg 90"]),
        (
            ["episode.gate_margin=-0.1", "reward.gate_offset=0"],
            ["episode.gate_margin is -0.1", "reward.edge"],
        ),
        (["episode.gate_margin=-0.97", "reward.edge=1"], ["episode.gate_margin is -0.97", "-0.9"]),
        (["reward.edge_margin=0.5", "reward.edge=1"], ["reward.edge_margin is 0.5", "0.5"]),
        (
            ["train.residual_ramp=[0, 9]", "vehicle.residual=r.npz", "train.steps=8"],
            ["train.residual_ramp", "train.steps 8"],
        ),
    ],
)
def test_what_does_not_go_with_the_rest(words, says):
    text = refusal(BLANK, *words)
    assert all(part in text for part in says), text


def test_a_constant_is_a_number():
    assert "vehicle.motor.k_w is {'x': 1}" in refusal(BLANK, "vehicle.motor.k_w.x=1")


def test_every_bound_names_a_key_that_exists():
    groups = (checks.CHOICES, checks.CLOSED, checks.HALF_OPEN_DISCOUNT, checks.AT_LEAST_ONE)
    for group in (*groups, checks.POSITIVE, checks.NOT_NEGATIVE):
        for key in group:
            checks.value_at(Config(), key)


def test_configs_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        load_config(BLANK).seed = 3


def test_fill_serves_other_schemas():
    @dataclasses.dataclass(frozen=True)
    class Small:
        x: float = 1.0
        y: list[float] | None = None

    assert fill(Small, {"x": 2}, "s.yaml") == Small(2.0)
    assert fill(Small, {"y": None}, "s.yaml") == Small()
    assert fill(Small, {"y": [1, 2]}, "s.yaml").y == [1.0, 2.0]
    with pytest.raises(InputError, match=r"s.yaml: unknown key z"):
        fill(Small, {"z": 2}, "s.yaml")


def test_merge_trees():
    under = {"a": {"b": 1, "c": 2}, "d": [1, 2]}
    merged = merge_trees(under, {"a": {"b": 3}, "d": [4], "e": 5})
    assert merged == {"a": {"b": 3, "c": 2}, "d": [4], "e": 5}
    assert under == {"a": {"b": 1, "c": 2}, "d": [1, 2]}


def test_a_script_reports_one_line_and_status_2(capsys):
    def main():
        raise InputError("a.yaml: seed is -1,\nallowed: 0 to 5")

    with pytest.raises(SystemExit) as caught:
        command_line(main)()
    assert caught.value.code == 2
    assert capsys.readouterr().err == "error: a.yaml: seed is -1, allowed: 0 to 5\n"
    for status, code in ((None, 0), (0, 0), (1, 1)):
        with pytest.raises(SystemExit) as caught:
            command_line(lambda status=status: status)()
        assert caught.value.code == code


@pytest.mark.parametrize("choice", ["on", "off", "auto"])
def test_on_and_off_are_words(choice):
    path = CONFIGS / "fit" / "standin.yaml"
    assert load_fit_config(path, [f"residual.mirror={choice}"]).residual.mirror == choice


@pytest.mark.parametrize(("word", "meant"), [("on", True), ("off", False), ("true", True)])
def test_on_and_off_are_understood_as_true_and_false(word, meant):
    words = [f"episode.random_gate={word}", "vehicle.residual=null"]
    config = load_config(CONFIGS / "e2e.yaml", words)
    assert config.episode.random_gate is meant and config.vehicle.residual is None
