"""The emitted observation and gate logic: one header and one source."""

import numpy as np

from quadjax.export import race_emulator
from quadjax.export.emit_network import Provenance
from quadjax.export.race_tables import YAW_EXPONENT, RaceTables, Rescale, state_names
from quadjax.export.render import comment, fill, literal, literal_64, wrapped

FIELD_NOTES = {
    "position": "m, world",
    "velocity": "m/s, world",
    "euler": "roll, pitch, yaw, rad; any yaw, wrapped here",
    "rates": "p, q, r, rad/s, body",
    "rpm": "1 front-left, 2 front-right, 3 rear-right, 4 rear-left",
    "thrust": "specific thrust along body -z, m/s^2",
    "moment_ext": "external moment, N m, body",
    "force_ext": "external specific force, m/s^2, body",
}
SQUARE = """\
/* Whether a point, relative to the gate's centre, is within the opening: along the gate's axes. */
static bool is_inside(const gate *g, int64_t x, int64_t y, int64_t z) {
  return (magnitude(round_shift(across(g, x, y), Q30)) <= g->half_width) &&
         (magnitude(z) <= g->half_height);
}"""
WORLD_BOX = """\
/* Whether a point, relative to the gate's centre, is within the opening: along the world's axes. */
static bool is_inside(const gate *g, int64_t x, int64_t y, int64_t z) {
  return (magnitude(x) < g->half_width) && (magnitude(y) < g->half_width) &&
         (magnitude(z) < g->half_height);
}"""
RANDOM_TESTS, FLOWN_TESTS = 6, 10


def self_test_states(
    tables: RaceTables, flown: np.ndarray | None, targets: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """States (n, state_size) float32 and targets (n,): flown ones, random ones and NaN."""
    rng = np.random.default_rng(0)
    ranges = np.ldexp(1.0, np.asarray(tables.exponents))
    count = RANDOM_TESTS if flown is not None and len(flown) else RANDOM_TESTS + FLOWN_TESTS
    random = (rng.uniform(-0.5, 0.5, (count, len(ranges))) * ranges).astype(np.float32)
    random[0] *= np.float32(10.0)
    random[1, :] = np.nan
    goals = rng.integers(0, tables.gates, count)
    if flown is None or targets is None or not len(flown):
        return random, goals
    pick = np.linspace(0, len(flown) - 1, FLOWN_TESTS).astype(int)
    return (
        np.concatenate([random, flown[pick].astype(np.float32)]),
        np.concatenate([goals, targets[pick]]),
    )


def emit_race(
    tables: RaceTables,
    origin: Provenance,
    command_type: str,
    states: np.ndarray,
    targets: np.ndarray,
) -> dict[str, str]:
    """The header and the source, by file name."""
    names = state_names(tables)
    start = {name: names.index(_first(name, count)) for name, count in tables.fields}
    values = {
        "name": origin.name,
        "NAME": origin.name.upper(),
        "provenance": comment(origin.lines),
        "gates": str(tables.gates),
        "state_size": str(tables.state_size),
        "command_type": command_type,
        "self_tests": str(len(states)),
        "state_fields": _state_fields(tables, start),
        "position_exponent": str(tables.exponents[start["position"]]),
        "velocity_exponent": str(tables.exponents[start["velocity"]]),
        "input_position_exponent": str(tables.network_exponents[0]),
        "input_velocity_exponent": str(tables.network_exponents[3]),
        "input_yaw_exponent": str(tables.network_exponents[8]),
        "yaw_exponent": str(YAW_EXPONENT),
        "turns_per_unit": str(tables.turns_per_unit),
        "two_pi": str(tables.two_pi),
        "gate_table": _gate_table(tables),
        "opening": WORLD_BOX if tables.world_box else SQUARE,
        "exponents": ", ".join(map(str, tables.exponents)),
        "state_values": wrapped(f"state->{name}" for name in names),
        "scaled_inputs": _scaled_inputs(tables),
        "state_from_bits": "\n".join(
            f"  state.{name} = float_of(bits[{i}]);" for i, name in enumerate(names)
        ),
    }
    values |= _tests(tables, states, targets)
    return {
        f"{origin.name}_race.h": fill("race.h.in", values),
        f"{origin.name}_race.c": fill("race.c.in", values),
    }


def _first(name: str, count: int) -> str:
    return f"{name}[0]" if count > 1 else name


def _state_fields(tables: RaceTables, start: dict[str, int]) -> str:
    lines = []
    for name, count in tables.fields:
        ranges = [2.0**e for e in tables.exponents[start[name] : start[name] + count]]
        distinct = list(dict.fromkeys(ranges))
        shown = ", ".join(f"+-{x:g}" for x in (distinct if len(distinct) == 1 else ranges))
        array = f"[{count}]" if count > 1 else ""
        lines.append(f"  float {name}{array}; /* {FIELD_NOTES[name]} ({shown}) */")
    return "\n".join(lines)


def _gate_table(tables: RaceTables) -> str:
    rows = []
    for g in range(tables.gates):
        position = ", ".join(map(str, tables.gate_position[g]))
        following = ", ".join(map(str, tables.next_gate[g]))
        numbers = ", ".join(
            [
                str(tables.gate_cos[g]),
                str(tables.gate_sin[g]),
                *map(str, tables.half_size[g]),
                literal_64(int(tables.gate_yaw[g])),
            ]
        )
        rows.append(f"    {{{{{position}}}, {numbers},\n     {{{following}}}}}")
    return ",\n".join(rows)


def _scaled_inputs(tables: RaceTables) -> str:
    motor = tables.vehicle == "motor"
    actuators = 4 if motor else 1
    lines = []
    for index in range(actuators):
        lines.append(_scaled(tables.scaled[index], 12 + index, 12 + index))
    for index in range(4):
        lines.append(f"  q[{12 + actuators + index}] = g->next[{index}];")
    if motor:
        # Of the external force only the z component.
        for index, number in enumerate((16, 17, 18, 21)):
            lines.append(_scaled(tables.scaled[4 + index], 20 + index, number))
    return "\n".join(lines)


def _scaled(rescale: Rescale | None, position: int, number: int) -> str:
    if rescale is None:
        return f"  q[{position}] = 0; /* the policy was trained without it */"
    call = f"rescale(s[{number}], {rescale.middle}, {rescale.factor}, {rescale.shift})"
    return f"  q[{position}] = hold({call}, outside, {position}U);"


def _tests(tables: RaceTables, states: np.ndarray, targets: np.ndarray) -> dict[str, str]:
    observed = race_emulator.observe(tables, states, targets)
    status = np.stack([observed.clipped, observed.nan, observed.outside], axis=1)
    bits = np.ascontiguousarray(states, np.float32).view(np.uint32)

    def rows(values: list[list[str]]) -> str:
        return ",\n".join("    {" + wrapped(row, "     ").strip() + "}" for row in values)

    return {
        "test_states": rows([[f"0x{b:08X}U" for b in row] for row in bits.tolist()]),
        "test_targets": ", ".join(map(str, targets.tolist())),
        "test_inputs": rows([[literal(v) for v in row] for row in observed.q.tolist()]),
        "test_statuses": rows([[f"{v}U" for v in row] for row in status.tolist()]),
    }
