"""Training configs: the presets, and every mistake as one line that names what is allowed."""

import shlex
from pathlib import Path

import pydantic
import pytest

from quadjax.config.loading import load_config, parse_config
from quadjax.config.schema import Reward
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS, preset_names
from quadjax.core.yaml_files import flatten
from quadjax.core.yaml_layers import read_layers
from quadjax.fitting.config import load_fit_config
from quadjax.sweeps.sweep import load_sweep
from tests import reference as ref
from tests.race.support import BLANK


def refusal(path, *overrides):
    with pytest.raises(InputError) as caught:
        load_config(path, overrides)
    text = str(caught.value)
    assert text and "\n" not in text
    return text


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_loads_and_its_dump_needs_no_other_file(name, tmp_path):
    config = load_config(name)
    assert config.name == name
    (tmp_path / "config.yaml").write_text(config.to_yaml())
    assert load_config(tmp_path / "config.yaml") == config
    assert config.vehicle.file is None and config.track.file is None


def test_every_shipped_vehicle_track_and_sweep_loads():
    far = "rules.position_limit=null"
    for kind in ("vehicles", "tracks"):
        for name in preset_names(kind):
            assert load_config("e2e +fastest", [f"{kind[:-1]}={name}", far])
    for name in preset_names("sweeps"):
        assert load_sweep(CONFIGS / f"sweeps/{name}.yaml")


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_no_preset_changes_what_it_inherits(path):
    """Each key below the top level is set once along the bases of a preset."""
    keys = [key for _, tree in read_layers(path) for key in flatten(tree, ["linear"])]
    keys = [key for key in keys if key != "name"]
    assert keys and len(keys) == len(set(keys)), sorted(k for k in keys if keys.count(k) > 1)


def test_presets_that_are_published_have_the_published_reward():
    printed = ("e2e_paper", "indi_paper", "e2e_paper +authors_code")
    flown = ("e2e_table1", "indi_table1")
    for name in (*printed, *flown, "e2e_ppo", "indi_ppo"):
        assert load_config(name).reward == Reward()


def test_defaults_are_the_published_model():
    config = load_config(BLANK)
    assert config.vehicle.constants == ref.MOTOR and config.vehicle.models == {"rate": ref.RATE}
    assert load_config(BLANK, ["vehicle.model=rate"]).vehicle.constants == ref.RATE
    assert [list(gate.position) for gate in config.track.gates] == ref.GATES.tolist()
    assert [gate.yaw_deg for gate in config.track.gates] == [45, 135, 225, 315]
    assert all(gate.size == (1, 1) for gate in config.track.gates)
    assert config.start.roll_pitch_deg == 40 and config.start.body_rates == 1
    assert config.training_limits.episode_steps == 1200 and config.rules.time_step == 0.01
    assert config.rules.gate_test == "square"
    drawn = dict(config.randomization)
    assert drawn.pop("width") == 1.0 and not any(drawn.values())  # of all, which are zero


def test_overrides():
    words = "vehicle.model=rate vehicle.constants.d_x=0.5 run.steps=2e6 rules.position_limit=null"
    config = load_config(BLANK, [*words.split(), "network.hidden=[32, 16]", "track=figure8"])
    assert config.network.hidden == (32, 16) and config.vehicle.model == "rate"
    assert config.vehicle.constants == ref.RATE | {"d_x": 0.5}
    assert config.run.steps == 2_000_000 and config.rules.position_limit is None
    assert config.track.name == "figure8"
    with pytest.raises(pydantic.ValidationError):
        config.seed = 3


def test_another_algorithm_starts_from_its_own_defaults():
    config = load_config("e2e", ["learner.algorithm=ppo", "learner.num_epochs=2"])
    assert (config.learner.algorithm, config.learner.num_epochs) == ("ppo", 2)
    assert config.learner.learning_rate == 7e-4
    assert set(config.schedules) == {"reward.pitch_up"}
    assert load_config("e2e", ["learner.algorithm=shac"]).learner.ema_rate == 0.03


def test_schedules_are_merged_and_removed():
    config = load_config("e2e +fastest", ["schedules.learner.std.linear=[0.4, 0.2, 0.1]"])
    assert config.schedules["learner.std"].linear == (0.4, 0.2, 0.1)
    again = load_config("e2e +fastest", ["schedules={learner.std: null, reward.gate_edge: null}"])
    assert set(again.schedules) == {"learner.learning_rate", "learner.critic_learning_rate"}
    assert load_config("e2e +fastest", ["schedules=null"]).schedules == {}
    own = "tests.race.test_extensions:speed"
    weight = f"schedules={{'reward.terms.{own}': {{linear: [0, value]}}}}"
    config = load_config(BLANK, [f"reward.terms={{{own}: 0.5}}", weight])
    assert config.schedules[f"reward.terms.{own}"].linear == (0.0, "value")


def test_parts_are_merged_over_a_preset_and_below_overrides(tmp_path, monkeypatch):
    fast = load_config("e2e", ["run.steps=5000", "+fastest", "+disturbance"])
    assert (fast.reward.gate_edge, fast.disturbance.moment_x) == (100.0, 0.03)
    assert (fast.run.steps, fast.name) == (5000, "e2e_fastest_disturbance")
    assert load_config("e2e +fastest +disturbance run.steps=5000") == fast
    assert load_config("e2e", ["name=mine", "+residual"]).name == "mine"
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text("base: e2e\nname: mine\n")  # has the parts of e2e
    mine = load_config("mine.yaml +fastest")
    assert mine == load_config("e2e +fastest name=mine_fastest")
    Path("parts").mkdir()
    Path("parts/heavy.yaml").write_text("vehicle: {constants: {k_w: 5.0e-8}}\n")
    for part in ("+heavy", "+parts/heavy.yaml"):
        config = load_config("e2e", [part])
        assert (config.name, config.vehicle.constants["k_w"]) == ("e2e_heavy", 5.0e-8)
    assert "did you mean fastest" in refusal("e2e", "+fastes")
    assert "gate_edge" in refusal("e2e_race +nosuch")


def test_a_vehicle_and_a_track_next_to_the_config(tmp_path):
    text = (CONFIGS / "vehicles" / "bebop1.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(text.split("rate:")[0].replace("g: 9.81", "g: 9.7"))
    (tmp_path / "hall.yaml").write_text("gates: [{position: [1, 2, -3]}, {position: [3, 2, -3]}]\n")
    path = tmp_path / "c.yaml"
    path.write_text("base: e2e\nvehicle:\n  file: mine.yaml\ntrack: hall\n")
    config = load_config(path)
    assert config.vehicle.constants["g"] == 9.7 and config.vehicle.models == {}
    assert config.track.name == "hall" and len(config.track.gates) == 2
    (tmp_path / "runs").mkdir()
    saved = tmp_path / "runs" / "config.yaml"
    saved.write_text(config.to_yaml())
    (tmp_path / "mine.yaml").unlink()
    (tmp_path / "hall.yaml").unlink()
    assert load_config(saved) == config
    other = load_config(saved, ["track=figure8", "vehicle=bebop1"])
    assert other.track.name == "figure8" and other.vehicle.constants["g"] == 9.81
    assert "vehicle.constants.g is missing; Parrot Bebop 1 has constants of: motor" in refusal(
        saved, "vehicle.model=rate"
    )


BEBOP = (CONFIGS / "vehicles" / "bebop1.yaml").read_text()
WITHOUT_K_W = "".join(line for line in BEBOP.splitlines(True) if not line.startswith("  k_w"))
DRONE, HALL = "vehicle: {file: mine.yaml}", "track: {file: hall.yaml}"
FILES = [  # of a config, of the file that it names, and the message
    (DRONE, {"mine.yaml": WITHOUT_K_W}, "vehicle.constants.k_w is missing"),
    (DRONE, {"mine.yaml": BEBOP + "colour: red\n"}, "mine.yaml: colour is 'red'"),
    (DRONE, {"mine.yaml": "motor: 3\n"}, "mine.yaml: motor is 3"),
    (HALL, {}, "c.yaml: track.file: 'hall.yaml': no such file"),
    (HALL, {"hall.yaml": "gate: []\n"}, "unknown key gate; did you mean gates?"),
    ("base: par", {}, "c.yaml: base: 'par': no such file"),
    ("# nothing", {}, "c.yaml: empty; write at least the preset to start from"),
]


@pytest.mark.parametrize(("text", "files", "says"), FILES, ids=[says for *_, says in FILES])
def test_files_of_a_config_are_checked(tmp_path, text, files, says):
    for name, content in {"c.yaml": text, **files}.items():
        (tmp_path / name).write_text(content)
    assert says in refusal(tmp_path / "c.yaml")


def test_an_error_names_the_file_that_sets_the_key(tmp_path):
    track, drone, base = tmp_path / "t.yaml", tmp_path / "d.yaml", tmp_path / "base.yaml"
    gates = "gates: [{position: [2, -1.5, -1.5], yaw_deg: %s}, {position: [2, 1.5, -1.5]}]"
    track.write_text(gates % "abc")
    drone.write_text((CONFIGS / "vehicles/bebop1.yaml").read_text().replace("k_w: ", "k_w: -"))
    base.write_text(f"base: {BLANK}\nreward: {{gate: much}}\n")
    assert refusal(BLANK, f"track={track}").startswith(f"{track}: track.gates[0].yaw_deg is 'abc'")
    assert refusal(BLANK, f"vehicle={drone}").startswith(f"{drone}: vehicle.constants.k_w is -")
    assert refusal(base).startswith(f"{base}: reward.gate is 'much'")
    assert refusal(base, "reward.gate=more").startswith("overrides: reward.gate is 'more'")
    base.write_text(f"base: {BLANK}\nseed: -1\n")
    assert refusal(base, "reward.gate=2").startswith(f"{base}: seed is -1, allowed")
    with pytest.raises(InputError, match=r"^overrides: logs.files is 3, allowed"):
        load_fit_config("standin", ["logs.files=3"])
    track.write_text(gates % "90" + "\nrules: {position_limit: 1}")
    assert refusal(BLANK, f"track={track}").startswith(f"{track}: track.gates[0].position is")


def test_a_path_is_never_split_into_words(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words in ("e2e track=figure8 seed=2", "e2e +gate_edge track=figure8 seed=2"):
        config = load_config(words)
        assert (config.track.name, config.seed) == ("figure8", 2)
    named = Path("my +own seed=3.yaml")
    named.write_text("base: e2e\nseed: 7\n")
    assert load_config(named).seed == load_config(str(named)).seed == 7
    track = (CONFIGS / "tracks/figure8.yaml").read_text()
    for name in ("t", "t #1.yaml", "t*.yaml", "@t.yaml"):
        Path(name).write_text(track.replace("name: figure8", f"name: '{name}'"))
        assert load_config("e2e", [f"track={name}"]).track.name == name


def test_a_schedule_in_an_override_replaces_the_whole():
    key, usual = "learner.std", load_config("e2e").schedules["learner.std"]
    assert usual.start == 0.5
    own = load_config("e2e", [f"schedules.{key}={{linear: [0.3, 0.05]}}"]).schedules[key]
    assert (own.linear, own.start, own.until) == ((0.3, 0.05), 0.0, 1.0)
    for text in (
        "schedules={learner.std: {linear: [value, 1]}}",
        f"schedules.{key}={{linear: [1, 2]}}",
    ):
        assert load_config("e2e", [text]).schedules[key].start == 0.0
    changed = load_config("e2e", [f"schedules.{key}.until=0.8"]).schedules[key]
    assert (changed.linear, changed.start, changed.until) == (usual.linear, 0.5, 0.8)


REFUSED = """
rules.gate_depth=0.3 | rules.gate_depth is 0.3, allowed: 0.1 without rules.gate_frame
rules.ground_height=1 | rules.ground_height is 1.0, allowed: 0.4 without rules.ground_speed
reward.gate_edge_margin=0.2 | reward.gate_edge_margin is 0.2, allowed: 0.1 without reward.gate_edge
reward.gate_edge_reach=2 | reward.gate_edge_reach is 2.0, allowed: 1.0 without reward.gate_edge
curriculum.pass_rate=0.5 | is 0.5, allowed: 0.9 without a schedule with by: pass_rate
curriculum.duration=0.5 | is 0.5, allowed: 0.25 without a schedule with by: pass_rate
randomization.width=0.5 | width is 0.5, allowed: 1.0 where randomization draws no constants
randomization.motor_map=0.1 | randomization.motor_map is 0.1, allowed: 0.0 with vehicle.model=motor
observation.highest_rpm=none | highest_rpm is 'none', allowed: 'estimated' without battery
observation.actuators=false observation.actuator_range=[0,9] | without observation.actuators
start.thrust=[1,2] | start.thrust is [1.0, 2.0], allowed: [7.4, 7.6] with vehicle.model=motor
'schedules.rules.gate_depth={linear: [0.1, 0.3]}' | rules.gate_depth has no effect without rules.ga
steps=1000 | unknown key steps; did you mean run.steps?
runs=3 | unknown key runs; did you mean evaluate.runs?
num_envs=64 | did you mean learner.num_envs?
learner.lr=1 | unknown key learner.lr; did you mean learning_rate?
run.steps=1e19 | run.steps is 1e+19, allowed: less than or equal to 1000000000000
run.steps=1.5 | run.steps is 1.5, allowed: a whole number
schedules.learner.std=linear | is 'linear', allowed: a mapping
reward.terms=[mine:fast] | terms is ['mine:fast'], allowed: {module:function: weight}
rules=5 | rules is 5, allowed: a mapping
track.generate.seed=1 rules=5 | rules is 5, allowed: a mapping
track.opening=0.5 rules=5 | rules is 5, allowed: a mapping
'seed=1 #2' | seed is '1 #2', allowed: a whole number
'track=nosuch #1.yaml' | track: 'nosuch #1.yaml': no such file
vehicle.model=boat | vehicle.model is 'boat', allowed: motor, rate
vehicle.constants.k_w=0 | vehicle.constants.k_w is 0.0, allowed: a positive number
vehicle.constants.k_w=1 | give a thrust of 3.67e+06 to 4.93e+07 times the weight, allowed
vehicle.constants.i_xx=1 | i_xx is 1.0, allowed: at most 0.003296, the sum of the other moments
vehicle.width=1 | square4.yaml: track.gates[0].size is [1.0, 1.0], allowed: sides above 1 m, \
vehicle.width of Parrot Bebop 1
reward.overspeed=3 | reward.overspeed is 3.0, allowed: 20.0 without rules.speed_limit
vehicle.delay=[0,0.02] | vehicle.delay is [0.0, 0.02], allowed: at most rules.time_step, 0.01 s
vehicle.delay=[0.01,0] | vehicle.delay is [0.01, 0], allowed: [lowest, highest]
vehicle.constants.tau=0.005 | vehicle.constants.tau is 0.005, allowed: above 0.005 s
vehicle.mismatch.k_z2=1.1 | unknown key vehicle.mismatch.k_z2; did you mean k_z?
vehicle.residual_gain=0.5 | is 0.5, allowed: 1.0 without vehicle.residual
track.file=3 | track.file is 3, allowed: name of a file
'track.gates=[{position: [0, 0, 1]}]' | track.gates[0].position is [0.0, 0.0, 1.0], allowed
training_limits.gate_inflation=-0.5 | training_limits.gate_inflation is -0.5, allowed: above -0.5
'start.thrust=[8, 7]' | start.thrust is [8, 7], allowed: [lowest, highest]
vehicle.constants.k_x=-1e-4 | vehicle.constants.k_x is -0.0001, allowed: at least 0
'vehicle.mismatch={k_w: 0.1}' | vehicle.constants times vehicle.mismatch give a thrust of
'vehicle.mismatch={tau: 0.01}' | vehicle.constants.tau times its mismatch is 0.0006, allowed
start.roll_pitch_deg=120 | at most 89 without vehicle.quaternion
'track.gates=[{position: [0, 0, -1]}, {position: [0, 0, -1], yaw_deg: 180}]' | another place
'schedules.reward.gates.linear=[0, 1]' | overrides: schedules.reward.gates: no such number; \
did you mean gate or gate_offset?
'schedules.std.linear=[0, 1]' | schedules.std: no such number
learner.algorithm=shac 'schedules.std.linear=[0, 1]' | schedules.std: no such number; did you mean \
learner.std?
'schedules.learner.horizons.linear=[0, 1]' | no such number with learner.algorithm=ppo
'schedules.vehicle.constants.taus.linear=[0, 1]' | sets to a number; did you mean tau?
'schedules.reward.linear=[0, 1]' | schedules.reward: no such number; did you mean reward.
'schedules.rules.time_step={linear: [0.01, 0.02]}' | cannot be scheduled: filters and limits are
battery.charge=[0.5,1] 'schedules.vehicle.constants.tau={linear: [0.07, value]}' | numbers of the b
battery.charge=[0.5,1] 'schedules.battery.resistance={linear: [0.1, value]}' | numbers of the b
'schedules.randomization.width={linear: [0, 1]}' | randomization.width has no effect where
randomization.all=0.2 'schedules.randomization.thrust={linear: [0, 0.1]}' | values above randomiza
'schedules.run.steps.linear=[0, 1]' | schedules.run.steps: run.steps cannot be scheduled
'schedules.learner.discount={linear: [0.9, 1.0]}' | discount.linear[1]: learner.discount is 1, all
'schedules.reward.gate={linear: [0, 1], by: pass_rate, until: 5}' | gate.until is 5.0, allowed
'schedules.vehicle.constants.tau={linear: [0.06, 1e-4]}' | is 0.0001, allowed: above 0.005 s
'schedules.vehicle.mismatch.k_w={linear: [1, 0.9]}' | is null, allowed: a key
'schedules.vehicle.residual_gain={linear: [0, value]}' | vehicle.residual_gain has no effect
'rules.bounds=[[9, -9], [-9, 9], [-6, 0]]' | rules.bounds[0] is [9, -9], allowed: [low
'rules.bounds=[[1, 1], [-9, 9], [-6, 0]]' | rules.bounds[0] is [1.0, 1.0], allowed: [low
training_limits.gate_inflation=0.1 reward.gate_offset=0 | gate_inflation is 0.1
learner.shuffle_block=7 | shuffle_block is 7, allowed: a divisor of 64 (rollout
learner.algorithm=shac learner.num_envs=6 | critic_minibatches is 4, allowed: a di
vehicle=5inch 'randomization={population: all_racing_drones, lag: 0.1}' | null with fractions (
vehicle.model=rate 'battery.charge=[0.2, 1.0]' | , allowed: null with
vehicle.model=rate vehicle.residual=file.npz | 'file.npz', allowed: null with
vehicle.model=rate disturbance.moment_bias=[0.01,0,0] | disturbance.moment_bias
vehicle.model=rate observation.disturbance=estimated | observation.disturbance is
vehicle.model=rate vehicle.constants.thrust_max=9 | give a thrust of 0 to 0.917
run.steps=1000000 'schedules.reward.gate={linear: [0, value], until: 2e6}' | at most run.steps
'schedules.reward.gate={linear: [0, value], from: 0.5, until: 0.4}' | before until 0.4
'track.start={position: [0, 0, 0]}' | track.start.position is [0.0, 0.0, 0.0]
'rules.bounds=[[-1, 4], [-2, 2], [-5, 0]]' | within rules.bounds
track.closed=false evaluate.laps=1 | track.start is null, allowed
track.closed=false 'track.start={position: [-3, -1.5, -1.5]}' | evaluate.laps is 6, allowed: 1 with
rules.body_radius=19 | overrides: rules.body_radius is 19.0, allowed: below 0.5, half of
'track.gates=[{position: [0, 0, -2], pitch_deg: -90}]' rules.gate_test=world_box | square, because
'track.gates=[{position: [0, 0, -2], size: [2, 1], shape: circle}]' | of a circle
'rules.body_rate_limit=[20, 20]' | body_rate_limit
track.generate=3 | track.generate is 3, allowed: a mapping
'track.generate.leg=[5, 3]' | leg is [5, 3], allowed: [lowest, highest]
'track.generate.leg=[1, 2]' | leg is [1.0, 2.0], allowed: a longest of at least
track.generate.leg_ratio=3 | leg_ratio is 3, allowed with leg [3.0, 8.0]: less than
'track.generate.height=[1, 2]' | height is [1.0, 2.0], allowed: at least
track.generate.turn_deg=20 | found no track with gates 8, leg [3.0, 8.0] and turn_d
track.generate.seed=1 track.closed=false | track.closed has no effect
track=square4 track.generate.seed=1 | track.gates has no effect
track.generate.seed=1 rules.position_limit=3 | track.gates[0].position is
'track.gates=[{position: [5e5, 0, -2]}, {position: [0, 0, -2]}]' | position[0] is 500000, allowed: \
less than or equal to 10000
'track.gates=[{position: [0, 0, -2]}, {position: [9000, -10001, -2]}]' | position[1] is -10001, a
'track.gates=[{position: [0, 0, -2]}, {position: [9000, 0, -2]}]' | set rules: {position_limit: null
'track.gates=[{position: [0, 0, -2]}, {position: [6000, 0, -2]}]' | rules: {position_limit: 9000}
'track.start={position: [0, 20000, -1]}' | track.start.position[1] is 20000, allowed: less than
rules.position_limit=20000 | position_limit is 20000, allowed: less than or equal to 10000
'rules.bounds=[[-5, 5], [-5, 3e4], [-5, 0]]' | rules.bounds[1][1] is 30000, allowed: less than
start.position=20000 | start.position is 20000, allowed: less than or equal to 10000
'track.generate={gates: 100, leg: [900, 1000], turn_deg: 60}' | need a position_limit of 13267 m
observation.critic_constants=true | critic_constants is true, allowed: false where rand
randomization.all=0.2 randomization.width=0 observation.critic_constants=true | critic_constants is
track.closed=false 'track.start={position: [0, 0, -1]}' 'evaluate={laps: 1, gates: 3}' | null with
""".strip().splitlines()


@pytest.mark.parametrize("row", REFUSED)
def test_refused(row):
    """One override, or several together."""
    words, _, message = row.partition(" | ")
    assert message in refusal(BLANK, *shlex.split(words))


def test_a_schedule_without_effect_says_how_to_remove_it():
    expected = "vehicle.residual_gain has no effect without vehicle.residual; write schedules."
    assert expected in refusal("e2e +residual", "vehicle.residual=null")
    more = ["vehicle.residual=null", "schedules.vehicle.residual_gain=null"]
    assert load_config("e2e +residual", more)


ACCEPTED = """
vehicle.constants.k_z=-1e-6 vehicle.constants.k_h=-0.01 vehicle.constants.k_rr=-1e-4
'track.gates=[{position: [15, 0, -1]}, {position: [12, 0, -1]}]' \
  'schedules.rules.position_limit={linear: [20, 30]}'
'schedules.reward.body_rates={linear: [0.1, value]}'
vehicle.model=rate start.thrust=[1,2]
rules.gate_frame=0.2 rules.gate_depth=0.3 rules.ground_speed=1 rules.ground_height=1
reward.gate_edge_margin=0.2 'schedules.reward.gate_edge={linear: [0, 9]}'
curriculum.pass_rate=0.5 'schedules.reward.gate={linear: [1, 2], by: pass_rate}'
randomization.width=0.5 'schedules.randomization.all={linear: [0, 0.2]}'
observation.highest_rpm=none 'battery={}'
training_limits.gate_inflation=0.3 'reward={gate_edge: 5, gate_offset: 0}' \
  'schedules.reward.gate_edge={linear: [0, value]}'
""".strip().splitlines()


@pytest.mark.parametrize("row", ACCEPTED)
def test_accepted(row):
    """Small effects of a fit below zero; a schedule that never takes the key's own value."""
    assert load_config(BLANK, shlex.split(row))


@pytest.mark.parametrize(
    "key",
    [
        *("rules.body_radius", "rules.gate_frame", "start.along_leg"),
        *("reward.distance", "reward.action_change"),
    ],
)
def test_a_number_without_an_effect_at_0_is_null_there(key):
    """In a config, and in that of a policy file, which is then of the same race."""
    zero, null = (load_config("e2e", [f"{key}={value}"]) for value in (0, "null"))
    assert zero == null == load_config("e2e")
    section, name = key.split(".")
    tree = null.model_dump(by_alias=True)
    tree[section][name] = 0.0
    assert parse_config(tree, "file") == null
    assert f"{key} is false, allowed: a number" in refusal("e2e", f"{key}=false")


def test_no_frames_stay_none_with_another_opening():
    course = ["track=grand_challenge", "track.opening=0.55", "rules.gate_frame=0"]
    assert load_config("e2e_race", course).rules.gate_frame is None


def test_one_opening_for_all_gates():
    """It replaces their sizes before lengths in gates are computed; frames keep their edges."""
    own = load_config("e2e_race", ["track=grand_challenge", "track.opening=0.55"])
    assert {gate.size for gate in own.track.gates} == {(0.55, 0.55)} and own.track.opening is None
    assert own.rules.gate_frame == pytest.approx(0.6 + 0.475)
    assert own.training_limits.gate_inflation == pytest.approx(0.6 * 0.275)
    assert parse_config(own.model_dump(by_alias=True), "saved") == own
    with pytest.raises(InputError, match="opening is 3.0, allowed: at most 2.7, the outer edge of"):
        load_config("e2e_race", ["track=grand_challenge", "track.opening=3"])
    gate = "{position: [%d, 0, -1], yaw_deg: 0, size: [1.5, %g]}"
    several = f"track.gates=[{gate % (0, 1.5)}, {gate % (9, 2)}]"
    with pytest.raises(InputError, match=r"allowed: null with rules.gate_frame 0.6 .*\[1.5, 2.0\]"):
        load_config("e2e_race", ["track=grand_challenge", "track.opening=1", several])


def test_a_part_for_another_learner_names_the_algorithm():
    expected = "schedules.learner.std: no such number with learner.algorithm=ppo"
    assert expected in refusal("e2e_ppo", "+gate_edge")


@pytest.mark.parametrize("overrides", ["track=figure8", {"track": "figure8"}])
def test_overrides_are_a_list(overrides):
    with pytest.raises(InputError, match="overrides: .*, allowed: a list of texts"):
        load_config("e2e", overrides)


def test_an_override_in_the_place_of_a_config_is_named_as_one():
    with pytest.raises(InputError, match="track=figure8: an override, allowed after the name of"):
        load_config("track=figure8")
