"""Bad input is one line that names it, with exit status 2, and writes nothing.

The rows cover each kind of check once; the bounds of the schema are one loop in tests/config.
"""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from tests.commands import run

FILES = {
    "not.yaml": "a: [1",
    "list.yaml": "- 1\n- 2\n",
    "key.yaml": "base: e2e\nlerner: {}\n",
    "gates.yaml": "name: one\ngates:\n- {position: [0, 0], yaw_deg: 0}\n",
    "far.yaml": "gates:\n- {position: [10, 0, -2], yaw_deg: 90}\n",
    "based.yaml": "base: papparazzi\n",
    "abc.csv": "a,b,c\n1,2,3\n4,5,6\n",
    "bytes.npz": "PK not an archive",
    "notes.txt": "a text",
    "empty.csv": "",
    "short.csv": "time,rate_p\n0.0,0.1\n",
    "latin.yaml": b"seed: 1\nname: caf\xe9\n",
    "latin.csv": b"time,rate_p\n0.0,0.1\n0.1,\xff\n",
    "twice.yaml": "logs: {format: plain}\nlogs: {format: paparazzi}\n",
    "nothing.yaml": "name: nothing\n",
    "nocolumns.yaml": "columns: []\nconditions: [{label: a}]\n",
    "condition.yaml": "conditions: [{label: a, overrides: ['vehicle.mismach={k_w: 0.96}']}]\n",
    "code.py": "def term(step):\n    return 0.0\n",
}
ROWS = """
train | CONFIG
train nosuch | nosuch e2e
train not.yaml | not.yaml
train list.yaml | list.yaml
train key.yaml | lerner learner
train notes.txt | notes.txt
train e2e nosuch=1 | nosuch
train e2e learner.nosuch=1 | learner.nosuch
train e2e seed=-1 | seed -1
train e2e seed=one | seed one
train e2e learner.num_envs=0 | learner.num_envs 0
train e2e learner.discount=1.5 | learner.discount 1.5
train e2e learner.learning_rate=nan | learner.learning_rate
train e2e 'network.hidden=[0]' | network.hidden
train e2e network.activation=gelu | network.activation gelu relu
train e2e learner.std=0.05legs | learner.std
train e2e 'learner.std=0.05 legs' | learner.std legs
train e2e 'reward.body_rates=3 furlongs' | reward.body_rates furlongs
train e2e track=nosuch | nosuch square4
train e2e track=gates.yaml | gates.yaml position
train e2e track=tracks | tracks directory
train e2e --seeds 1 1 | --seeds twice
train e2e --seeds 0 x | --seeds x
train e2e --resum | --resum --resume
train e2e --resume --name nope | runs/nope resume --resume
train e2e seed=1 --seeds 0 1 | seed=1 effect --seeds
train e2e track= | track= value null
train e2e track=5 | track 5 square4 mapping
train e2e --resume --overwrite | exclude
train e2e --name ../out | --name
train e2e --output=-- | --output=-- value
train e2e --output notes.txt | notes.txt
train e2e vehicle=nosuch | nosuch
train e2e vehicle.constants.nosuch=1 | vehicle.constants.nosuch
train e2e vehicle.constants.mass=-1 | mass
train e2e vehicle.residual=nosuch.npz | nosuch.npz
train e2e rules.extra=[code:nosuch] | code nosuch
train e2e rules.extra=[nosuch:term] | nosuch
train e2e reward.extra=[code] | reward.extra
train e2e 'schedules.nosuch.key={linear: [0, 1]}' | schedules nosuch
train e2e 'schedules.learner.std={linear: [0, a]}' | schedules learner.std
train e2e 'schedules={learner.std: {lin: [0, 1]}}' | unknown key schedules.learner.std.lin linear
train e2e --fine-tune indi | --fine-tune rate motor
train gates.yaml | unknown key gates track=FILE
limit gates.yaml | unknown key gates track=FILE
show far.yaml | gates[0].position below rules.position_limit, 10 m {position_limit: 15}
show e2e 'rules.bounds=[[-5, 5], [-5, 5], [-1, 0]]' | gates[0].position z rules.bounds, -1 to 0
train e2e 'schedules.evaluate.laps={linear: [1, 2]}' | evaluate.laps key number
train e2e 'schedules.run.checkpoint_seconds={linear: [value, 2]}' | cannot be scheduled
train e2e reward.gate=3 'schedules.reward.gate={linear: [3, 3]}' | reward.gate effect
train 'e2e +fastest' 'learner.horizon=2 legs' | learner.horizon legs times
train 'e2e +fastest' 'learner.discount=-1 leg times' | learner.discount -1 above 0
train 'e2e +fastest' 'learner.horizon=1e308 leg times' | horizon 1e308 most 1e+09
train 'e2e +fastest' 'learner.num_envs=3 legs' | learner.num_envs legs per
train 'e2e +fastest' 'reward.gate_edge=3 legs' | gate_edge per half gate
train 'e2e +fastest' 'reward.gate_edge=3 per leg per leg time' | allowed per half gate
train 'e2e +fastest' 'reward.gate=2 feet' | reward.gate feet number
train 'e2e +fastest' 'run.steps=1 leg times' | run.steps whole number
train 'e2e +fastest' 'schedules.learner.std.linear=[1 legs, 2]' | learner.std.linear[0] legs
train e2e 'schedules.learner.std={linear: [0.3, -0.1]}' | schedules.learner.std.linear[1] -0.1
train e2e 'schedules.run.steps={linear: [1, 2]}' | schedules.run.steps cannot be scheduled number
train latin.yaml | latin.yaml line 2 not UTF-8 text
train twice.yaml | twice.yaml line 2: found duplicate key "logs"
train e2e_ppo learner.num_envs=10 learner.num_minibatches=7 | num_minibatches
train e2e --fine-tune bytes.npz | bytes.npz
train e2e --fine-tune nosuch.npz | nosuch.npz
evaluate e2e | --policy
evaluate e2e --policy nosuch | nosuch e2e_residual
evaluate e2e --policy e2e track=nosuch | overrides: track: 'nosuch' square4
evaluate e2e --policy e2e track.file=nosuch | overrides: track.file: 'nosuch'
evaluate e2e --policy e2e --body 19 | radius of 19 m track.gates[0].size
evaluate e2e --policy tracks | --policy tracks policy.npz run shipped e2e_residual
logs standin --policy e2e constants.sede=3 --output new | constants.sede seed
evaluate e2e --policy e2e --figures bytes.npz | bytes.npz folder
evaluate e2e --policy bytes.npz | bytes.npz
evaluate e2e --policy indi | rate motor
evaluate e2e --policy e2e --runs 0 | --runs 0
evaluate e2e --policy e2e --laps 2 --gates 3 | --gates --laps
evaluate e2e --policy e2e --seed -1 | --seed -1
evaluate e2e --policy e2e --json notes.txt/a.json | notes.txt
evaluate e2e --policy e2e --start floor | floor hover
evaluate e2e --policy e2e --states a.xyz | a.xyz
evaluate e2e --policy e2e --conditions spread --figures x | --figures effect --conditions
evaluate e2e --policy e2e --conditions protocols --deterministic | --deterministic effect
evaluate e2e --policy e2e --conditions nosuch | current folder lists of conditions quadjax: damage
evaluate e2e --policy e2e --conditions nocolumns.yaml | nocolumns.yaml: columns [] least 1 item
evaluate e2e --policy e2e --conditions condition.yaml | condition.yaml: condition a: mismach
evaluate e2e --policy e2e --conditions damage --only fog | damage: 'fog' modeled
evaluate e2e --policy e2e --conditions spread --plant standin | plant hover
evaluate e2e --policy e2e --only fog | --only --conditions
evaluate e2e --policy e2e --plant standin --gates 5 | plant laps hover
evaluate e2e --policy e2e --drones 2 | --drones effect --plant
evaluate e2e --policy e2e --plant standin --drones 3 --runs 4 | runs multiples (3)
evaluate track=figure8 --policy e2e | track=figure8 preset
report nosuch.npz | nosuch.npz no such file
report A= | A=: expected LABEL=FILE
report =a.npz | LABEL=FILE
report notes.txt | .npz .csv
report short.csv | short.csv format
compare nosuch | nosuch cyberzoo
compare effects.gusts=0 | effects.gusts=0 cyberzoo
compare --drones 2 | drones 2 plant
compare standin --conditions calm | lists of conditions quadjax: damage
compare standin --conditions plants --only calm | plants: 'calm' effects
compare standin --only calm | --only effect --conditions
compare standin --e2e indi | rate motor
compare standin --e2e e2e nosuch | --e2e nosuch e2e_residual
compare standin --failed-after 0 | --failed-after 0
compare standin effects.wind=1 | effects.wind
compare +hall | +hall: before 'e2e +hall'
compare standin +hall | +hall: before 'e2e +hall'
evaluate --policy e2e +hall | +hall: before 'e2e +hall'
evaluate +hall --policy e2e | +hall: before 'e2e +hall'
show +hall | +hall: before 'e2e +hall'
train +hall | +hall: before 'e2e +hall'
compare cyberzoo vehicle=5inch.yaml | 5inch.yaml cyberzoo bebop1.yaml base: plant/standin
compare standin --drones 10 --runs 25 | --runs multiples (10)
compare standin --name ../zz | ../zz
compare standin control_rate=300 | control_rate 300
compare standin sample_rate=400 | sample_rate
compare standin navigation=gps | navigation gps
compare standin effects.flapping=-1 | effects.flapping -1
compare standin 'airframe.limits={vx: [0.2, 0.1]}' | [0.2, [lowest,
compare standin 'battery.charge=[1.0, 0.5]' | battery.charge
compare standin indi.cutoff=400 | indi.cutoff 400
compare standin sensors.mocap.rate=501 | 500 Hz
compare standin sensors.mocap.latency=0.5 | sensors.mocap.latency 0.5 0.12
compare standin sensors.mocap.dropout=1 | sensors.mocap.dropout
compare standin sensors.accelerometer.bias_walk=.nan | bias_walk nan
compare standin sensors.gyro.low_pass=250 | sensors.gyro.low_pass 250 (none)
compare standin sensors.gps=1 | sensors.gps
view e2e --name a --name b | --name flights
view nosuch.npz | nosuch.npz run .csv shipped
view '' | '' run .csv shipped
view indi --race e2e | indi.npz vehicle.model=rate vehicle.model=motor own
view notes.txt | notes.txt
limit e2e track=nosuch | nosuch
limit e2e --clearance -1 | --clearance
limit e2e --laps 0 | --laps
limit e2e --laps 3 --gates 3 | --gates
limit e2e --speed 0 | --speed
limit e2e --guess '' | --guess '' file
limit e2e --centers --clearance 1 | --clearance --centers
limit 'indi +fastest' --clearance 0.5 | gate 1 0.5
limit 'indi +fastest' rules.gate_test=world_box | world_box
sweep nosuch | nosuch
sweep key.yaml | key.yaml
sweep learning_rate budget.trials=0 | overrides: budget.trials 0
fit nosuch | nosuch current folder fit configs paparazzi
fit latin.yaml | latin.yaml
fit gates.yaml | unknown key gates allowed there
show spread | spread show prints no lists of conditions spread.yaml
fit based.yaml | base: papparazzi current folder fit; did you mean paparazzi
fit paparazzi logs.files=abc.csv | abc.csv column 'time' missing
fit paparazzi logs.columns.tim=[a] | logs.columns.tim; mean time?
fit paparazzi logs.files=tracks | logs.files tracks folder tracks/*.csv
fit paparazzi logs.files=[latin.csv] | latin.csv line 3 not UTF-8 text
fit standin logs.files=[empty.csv] | empty.csv
fit standin logs.files=[short.csv] | short.csv
fit standin logs.files=[nosuch.csv] | nosuch.csv
fit paparazzi logs.files=[] | logs.files
fit paparazzi logs.files= | logs.files= value
fit paparazzi logs.format=foo | logs.format 'foo' paparazzi module:OBJECT
fit paparazzi logs.files=[short.csv] logs.format=betaflight | logs.format betaflight blackbox
fit paparazzi logs.files=[short.csv] logs.format=nowhere:FORMAT | logs.format nowhere
fit paparazzi logs.files=[short.csv] logs.columns.rpms=[a] | rpms
fit paparazzi logs.files=[short.csv] logs.columns.rpm=[a] | rpm
fit paparazzi logs.files=[short.csv] residual.hiden=3 | residual.hiden epochs
fit paparazzi logs.files=[short.csv] residual.epochs=many | residual.epochs many
fit paparazzi logs.files=[short.csv] vehicle=nowhere.yaml | nowhere.yaml current folder
fit paparazzi logs.files=[short.csv] body.inertia=null | body.inertia
fit paparazzi logs.files=[short.csv] 'body.rpm_range=[5000, 3000]' | body.rpm_range
fit paparazzi logs.files=[short.csv] 'body.rpm_range=[5000, 5000]' | body.rpm_range
replay empty.csv --policy e2e | empty.csv
replay short.csv --policy e2e --logs paparazzi | short.csv
replay short.csv | --policy --vehicle
replay short.csv --vehicle nothing.yaml | nothing.yaml: vehicle.constants.g missing
replay short.csv --policy e2e --residual x.npz | --residual --vehicle
replay short.csv --policy e2e --drive wind | --drive
replay short.csv --policy e2e --json x.txt | .txt
replay short.csv --policy e2e --logs nosuch | nosuch
logs nosuch --policy e2e --output out | nosuch current folder plants exact
logs exact control_rate=333 --policy e2e --output out | overrides: control_rate 333
logs standin --flights 0 | --output missing
logs standin --policy e2e --output | --output argument
export nosuch --output out | nosuch
export e2e --output notes.txt | notes.txt
export e2e --output out --target avr | avr cortex-a9
export e2e --output out --range nosuch=4 | nosuch
export e2e --output out --range position=-1 | position
export e2e --output out --range velocity=3 | velocity power two
export e2e --output out --range velocity=nan | velocity power two
export e2e --output out --range velocity | velocity power two
export e2e --output out --range velocity=32 --range velocity=16 | velocity two
export e2e --output out --name qj | runtime names
export e2e --output out --name quadjax_policy | runtime names
export e2e --output out --name string | runtime names policy_string
export e2e --output out --name sys_time | runtime names policy_sys_time
export e2e --output out --track nowhere.yaml | nowhere.yaml
export e2e --output= | --output
export e2e --output out --target indiflight | indiflight motor racing vehicle=5inch
verify nosuch | nosuch folder export
verify '' | DIR '' folder export
verify tracks | tracks _report.json folder export
verify notes.txt | notes.txt
sil nosuch | nosuch folder policy
sil e2e --target indiflight | indiflight motor racing vehicle=5inch
sil indi --delay 5 | --delay effect --late
sil indi --simulator effects.gusts=0 | effect --simulator
sil indi --wrong-unit rates=turns | --wrong-unit rates=turns
sil indi --drop 2 | 0 to 1
sil indi wings=2 | wings
import e2e notes.txt --output new.npz | notes.txt
import e2e bytes.npz --output new.npz | bytes.npz
show nosuch | nosuch
show '' | '' lists
show new.yaml --write track gates=0 | overrides: gates 0
show square4 extra | extra
show square4 --figure nosuch/x.png | nosuch
show e2e run.steps=-5 | run.steps -5
show new.yaml --write vehicle mass=0.6 wheelbase=0.2 propeller=0.1 | motor_kv
show new.yaml --write vehicle mass=0.6 wheelbase=0.2 propeller=0.1 thrust_to_weight=0.5 | 0.5
show new.yaml --write vehicle mass=0.6 wheelbase=0.2 propeller=0.1 'inertia=[0, 1, 1]' | inertia
show new.yaml --write vehicle mass=0.6 wheelbase=0.2 propellor=0.1 | propellor propeller
nosuch | nosuch train
""".strip().splitlines()
ROWS.append(f"export e2e --output out --name {'a' * 300} | identifier")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files of a user."""
    path = tmp_path_factory.mktemp("refusals")
    (path / "tracks").mkdir()
    for name, text in FILES.items():
        (path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def contents(folder: Path) -> dict[str, bytes]:
    """Every file and folder below a folder, by its path; compiled Python is left out."""
    paths = (path for path in folder.rglob("*") if "__pycache__" not in path.parts)
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in paths
    }


@pytest.mark.parametrize("row", ROWS)
def test_refused_in_one_line(row, folder, capfd, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    command, _, words = row.rpartition(" | ")
    before = contents(folder)
    assert run(*shlex.split(command)) == 2
    printed = capfd.readouterr()
    lines = printed.err.strip().splitlines()
    message = lines[-1]
    assert "Traceback" not in printed.err
    assert all(re.search(re.escape(word), message) for word in words.split()), message
    assert [line for line in lines if "error: " in line] == [
        message
    ]  # usage and progress precede it
    assert contents(folder) == before


def test_a_damaged_policy_names_what_is_wrong(tmp_path, capfd):
    np.savez(tmp_path / "p.npz", kernel_0=np.zeros((3, 4)), meta="{}")
    assert run("evaluate", "e2e", "--policy", tmp_path / "p.npz") == 2
    assert "p.npz" in capfd.readouterr().err
