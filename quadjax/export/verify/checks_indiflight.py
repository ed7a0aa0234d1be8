"""Checks of INDIflight's files: warnings, commands in range, an emulated M7, whole races."""

import ctypes
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.export.actor import fixed_point_fly
from quadjax.export.indiflight import FOLDER, MOTORS
from quadjax.export.race_source import OwnRace
from quadjax.export.verify.checks_arm import need_emulator
from quadjax.export.verify.checks_static import eva, proven
from quadjax.export.verify.context import Context
from quadjax.export.verify.emitted import write_indiflight_eva, write_loop, write_memory
from quadjax.export.verify.harness import load_library
from quadjax.export.verify.result import Skipped, require
from quadjax.export.verify.toolchain import (
    Compiler,
    arm_none_eabi,
    host,
    need_program,
    zig_thumb,
)
from quadjax.race import environment, laps
from quadjax.race.environment import Choices, RaceParams, RaceState
from quadjax.race.laps import Laps, LapState

WARNINGS = "-std=c99 -Wall -Wextra -Wdouble-promotion -Werror".split()
RANDOM_STATES, FEW_RUNS, RACE_LAPS = 20_000, 8, 6


def _files(c: Context) -> list[Path]:
    return [c.folder.path / file for file in c.folder.expected if file.startswith(f"{FOLDER}/")]


def _sources(c: Context) -> list[Path]:
    return [file for file in _files(c) if file.suffix == ".c"]


def check_warnings(c: Context) -> str:
    """No warning under the firmware's options, from every compiler that is found."""
    names = []
    for make in (host, lambda: zig_thumb("Cortex-M7"), lambda: arm_none_eabi("Cortex-M7")):
        try:
            compiler = make()
        except Skipped:
            continue
        for source in _sources(c):
            compiler.build([source], c.work / "warnings.o", [*WARNINGS, "-c"])
        names.append(compiler.name)
    require(bool(names), "no compiler")
    return f"{', '.join(names)}: {' '.join(WARNINGS[:-1])}"


@dataclasses.dataclass
class Controllers:
    """nn_control of many drones."""

    library: ctypes.CDLL
    memory: np.ndarray

    @classmethod
    def begin(cls, library: ctypes.CDLL, world: np.ndarray, targets: np.ndarray) -> "Controllers":
        """Races that begin at states (n, 16), with a target (n,) each."""
        memory = np.zeros((len(world), library.loop_size()), np.uint8)
        goals = np.ascontiguousarray(targets, np.uint32)
        library.loop_begin(*_pointers(memory, world, goals), len(world))
        return cls(library, memory)

    def step(self, world: np.ndarray) -> np.ndarray:
        """Motor commands (n, 4) of states (n, 16), both in INDIflight's order."""
        commands = np.zeros((len(world), 4), np.float32)
        self.library.loop_step(*_pointers(self.memory, world, commands), len(world))
        return commands


def _pointers(*arrays: np.ndarray) -> list[ctypes.c_void_p]:
    return [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]


def _library(c: Context) -> ctypes.CDLL:
    network = c.folder.path / FOLDER / "neural_network.c"
    sources, extra = [network, write_loop(c.folder, c.work)], [f"-I{network.parent}"]
    if any(field.name == "quaternion" for field in c.folder.race.fields):
        extra.append("-lm")
    return load_library(host(), sources, c.work / "loop.so", extra)


def hostile_states(count: int, seed: int = 0) -> np.ndarray:
    """States (count, 16) float32 of any bits: ordinary, huge, infinite, NaN."""
    rng = np.random.default_rng(seed)
    states = rng.uniform(-30.0, 30.0, (count, 16)).astype(np.float32)
    half = rng.integers(0, 2**32, (count // 2, 16), dtype=np.uint32).view(np.float32)
    states[: count // 2] = half
    bad = np.array([np.nan, np.inf, -np.inf, 3e38, 1e-42], np.float32)
    rows = rng.integers(count // 2, count, 2000)
    states[rows, rng.integers(0, 16, len(rows))] = np.resize(bad, len(rows))
    return states


def check_any_state(c: Context) -> str:
    """Motor commands are within 0 and 1, whatever the state."""
    library, states = _library(c), hostile_states(RANDOM_STATES)
    require(library.nn_self_test() == 0, "self-test mismatches")
    gates = np.arange(len(states)) % c.folder.race.gates
    commands = Controllers.begin(library, states, gates).step(states)
    inside = (commands >= 0.0) & (commands <= 1.0)  # false for NaN
    require(bool(inside.all()), f"{np.sum(~inside)} commands out of range")
    return f"{len(states)} states of any bits: every command within 0 and 1"


def check_machine(c: Context) -> str:
    """An emulated Cortex-M7 gives the host's motor commands, and passes the self-tests."""
    need_emulator()
    from quadjax.export.verify.machine import Machine

    compiler: Compiler = zig_thumb("Cortex-M7")
    if any(field.name == "quaternion" for field in c.folder.race.fields):
        raise Skipped("needs sinf and cosf of a C library for the Cortex-M7")
    sources = [*_sources(c), write_memory(c.work)]
    machine = Machine(
        compiler.build(sources, c.work / "indiflight.elf", ["-Wl,-e,nn_control"]), "Cortex-M7"
    )
    require(machine.call("nn_self_test") == 0, "self-test mismatches")
    states = hostile_states(2000, seed=1)[::20].copy()
    library, out, most, stack = _library(c), machine.reserve(16), 0, 0
    for state in states:
        goal = np.zeros(1, np.uint32)
        expected = Controllers.begin(library, state[None], goal).step(state[None])[0]
        machine.call("nn_reset")
        count, used = machine.count("nn_control", machine.place(state), out)
        most, stack = max(most, count), max(stack, used)
        found = machine.read(out, np.float32, (4,))
        require(np.array_equal(found, expected), "other motor commands than the host's")
    return f"{len(states)} states the same; nn_control {most:,} instructions, {stack} B stack"


def check_eva(c: Context) -> str:
    """Frama-C EVA of nn_control: no alarm for any state and any memory of the controller.

    A controller with a motor number out of range raises alarms.
    """
    need_program("frama-c")
    folder, work = c.folder.path / FOLDER, c.work / "corrupted"
    work.mkdir(exist_ok=True)
    # Each includes the controller next to it, or else that of the folder.
    mains = [write_indiflight_eva(c.folder, where) for where in (c.work, work)]
    network = [folder / "neural_network.c"]
    count = proven(c, mains[0], network, folder)
    text = (folder / "nn_controller.c").read_text()
    numbers = "motor_number[4] = {"
    corrupted = text.replace(f"{numbers}{MOTORS[0]}", f"{numbers}{len(MOTORS)}")
    require(corrupted != text, "no motor numbers")
    (work / "nn_controller.c").write_text(corrupted)
    alarms, _ = eva(c, mains[1], network, folder)
    require(alarms > 0, "a motor number out of range raised no alarm")
    return (
        f"0 alarms for any state and memory; {count} assertions proven; "
        f"a wrong motor number: {alarms} alarms"
    )


def _world(own: OwnRace) -> Callable[[RaceState], jax.Array]:
    """A function from a batched race to the firmware's states (n, 16)."""

    @jax.jit
    def world(state: RaceState) -> jax.Array:
        drone = state.drone
        parts = (drone.position, drone.velocity, drone.angles, drone.rates)
        motion = jax.tree.leaves(parts)
        rotors = jax.tree.leaves(drone.actuators)
        ordered = [rotors[MOTORS.index(number)] for number in range(4)]
        return jnp.stack([*motion, *ordered], axis=1)

    return world


def _advance(own: OwnRace) -> Callable[[LapState, jax.Array], LapState]:
    """One step of all drones, by the simulator's rules, with actions (n, 4)."""
    one = functools.partial(laps.advance, *_exact(own))
    return jax.jit(jax.vmap(one, in_axes=(-1, 0), out_axes=-1))


def _exact(own: OwnRace) -> tuple[Choices, RaceParams]:
    return own.choices, environment.exact_rules(own.choices.model, own.params)


def races(c: Context, runs: int, lap_count: int = RACE_LAPS, seed: int = 3) -> tuple[Laps, Laps]:
    """The same starts flown in the simulator and through ``nn_control``."""
    own, (choices, params) = c.folder.own, _exact(c.folder.own)
    key, steps = jax.random.key(seed), laps.step_limit(params, lap_count)
    state = laps.starting_states(choices, params, key, runs, from_hover=False)
    actor = fixed_point_fly(c.folder.policy, c.folder.network.box.declared)
    flown, _ = laps.fly_race(choices, actor, lap_count, steps, False, params, own.pilot, state, key)
    low, high = np.float32(own.pilot.low), np.float32(own.pilot.high)
    world, advance, race = _world(own), _advance(own), laps.begin(state, lap_count)
    drones = Controllers.begin(_library(c), np.array(world(state)), np.asarray(state.target))
    for _ in range(steps):
        command = drones.step(np.array(world(race.state)))[:, MOTORS]
        race = advance(race, 2.0 * (command - low) / (high - low) - np.float32(1.0))
        if np.asarray(race.over).all():
            break
    limit = laps.time_limit(params.track, lap_count)
    reference, found = (laps.laps_of(choices, x, own.time_step, limit) for x in (flown, race))
    return reference, found


def check_races(c: Context) -> str:
    """Races through nn_control end as in the simulator, with lap times equal to one step."""
    runs = c.runs or FEW_RUNS
    reference, found = races(c, runs)
    require(reference.crashes == found.crashes, "other ends")
    same = np.isfinite(reference.lap_times) == np.isfinite(found.lap_times)
    require(bool(same.all()), "other laps completed")
    apart = np.nan_to_num(np.abs(reference.lap_times - found.lap_times))
    step = c.folder.own.time_step
    require(apart.max(initial=0.0) <= 1.001 * step, f"lap times {apart.max():.3g} s apart")
    return (
        f"{runs} races through nn_control end as in the simulator, {found.finished} finish; lap "
        f"times at most {apart.max(initial=0.0) / step:.0f} steps of {step:g} s apart"
    )
