"""The headers of an export: the policy as a table in C, its sizes, what the glue needs."""

import textwrap
from collections.abc import Iterable

import jax
import numpy as np

from quadjax.export.race_source import PolicyRace
from quadjax.export.race_tables import FIELDS
from quadjax.export.suitability import observed_fields
from quadjax.export.targets import RUNTIME
from quadjax.export.words import FixedPolicy
from quadjax.race import episode

WIDTH, INDENT = 100, "    "
SMALLEST_WIDTH = 16  # of the runtime's buffers: the estimator's inputs


def comment(lines: Iterable[str]) -> str:
    """Lines of a block comment, in which no text can end it."""
    return (
        "\n".join(f" * {line}".rstrip() for line in lines).replace("*/", "* /").replace("/*", "/ *")
    )


def words_table(name: str, data: bytes) -> str:
    """Words as a table in C, in lines of at most ``WIDTH`` characters."""
    words = np.frombuffer(data, "<i4").tolist()
    items = (str(x) if x > -(2**31) else "(-2147483647 - 1)" for x in words)
    lines = textwrap.wrap(
        ", ".join(items),
        WIDTH,
        initial_indent=INDENT,
        subsequent_indent=INDENT,
        break_on_hyphens=False,
    )
    text = "\n".join(lines)
    return f"static const int32_t {name}[{len(words)}] = {{\n{text}}};\n"


def policy_header(policy: FixedPolicy, data: bytes, facts: Iterable[str]) -> str:
    """``NAME.h``: the words of a policy as a table, its observation, and facts about its source."""
    box, guard = policy.network.box, policy.name.upper()
    lines = [f"{policy.name}: a quadcopter racing policy in fixed point, as words for qj.h.", ""]
    lines += [*facts, "", "Inputs, in this order, each within its range:"]
    inputs = zip(box.layout.labels, box.ranges, box.units, strict=True)
    for number, (label, limit, unit) in enumerate(inputs):
        lines.append(f"{number:3d}  {label:<17} +-{limit:g} {unit}")
    lines += ["", "State, as qj_observe takes it; in brackets the range of each number:"]
    for name, exponents in policy.race.fields.items():
        ranges = ", ".join(f"{2.0**e:g}" for e in dict.fromkeys(exponents))
        size = f"[{len(exponents)}]" if len(exponents) > 1 else ""
        lines.append(f"  {name + size:<17} {FIELDS[name][1]} (+-{ranges})")
    lines += ["", "Do not edit: the loader checks the words."]
    return (
        f"/*\n{comment(lines)}\n */\n#ifndef {guard}_H\n#define {guard}_H\n\n"
        "#include <stdint.h>\n\n"
        f'#define {guard}_POLICY_SHA256 "{policy.policy_hash}"\n\n'
        f"{words_table(f'{policy.name}_words', data)}\n"
        f"#endif /* {guard}_H */\n"
    )


def sizes_header(policy: FixedPolicy, any_policy: bool = False) -> str:
    """``qj_sizes.h`` for one policy: no buffer of the runtime is larger than it needs.

    With ``any_policy`` the sizes of the largest policy that the runtime takes, for firmware that
    loads files.
    """
    sampled = "" if policy.noise is None else "#define QJ_SAMPLED 1\n"
    if any_policy:
        return (RUNTIME / "qj_sizes.h").read_text("utf-8") + sampled
    layers = list(policy.network.layers)
    if policy.estimator is not None and (residual := policy.estimator.residual) is not None:
        layers += [*residual.thrust, *residual.moment]
    widest = max(max(layer.weights.shape) for layer in layers)
    sizes = {
        "WIDTH": max(SMALLEST_WIDTH, -(-widest // 8) * 8),
        "STATE": policy.race.state_size,
    }
    lines = "".join(
        f"#ifndef QJ_MAX_{name}\n#define QJ_MAX_{name} {size}\n#endif\n"
        for name, size in sizes.items()
    )
    return (
        f"/* Sizes of {policy.name}. */\n#ifndef QJ_SIZES_H\n#define QJ_SIZES_H\n"
        f"{lines}{sampled}#endif\n"
    )


def call_frequency(policy: FixedPolicy) -> int:
    """Calls of Paparazzi's module, Hz: at the rate of the estimators, if there are any."""
    estimator = policy.estimator or policy.battery
    return 512 if estimator is None else round(1e9 / estimator.period_ns)


def glue_header(policy: FixedPolicy, race: PolicyRace) -> str:
    """``quadjax_policy.h``: what the glue of an autopilot needs of its policy."""
    track = race.params.track
    drone = episode.hover_start(race.environment, race.params).drone

    def numbers(values: Iterable[object]) -> str:
        return "{" + ", ".join(f"{float(np.asarray(x))!r}F" for x in values) + "}"

    positions = np.stack([np.asarray(x) for x in track.position.components()], axis=1)
    rows = ", ".join(numbers(row) for row in positions)
    values = {
        "QUADJAX_WORDS": f"{policy.name}_words",
        "QUADJAX_OBSERVES_QUATERNION": int("quaternion" in observed_fields(policy.race)),
        "QUADJAX_FREQUENCY": call_frequency(policy),
        "NUM_GATES": len(positions),
        "QUADJAX_GATE_POSITIONS": "{" + rows + "}",
        "QUADJAX_GATE_YAWS": numbers(np.asarray(track.yaw)),
        "QUADJAX_START_POSITION": numbers(jax.tree.leaves(drone.position)),
        "QUADJAX_START_YAW": f"{float(drone.euler.z)!r}F",
    }
    lines = "\n".join(f"#define {name} {value}" for name, value in values.items())
    return (
        "/* The policy that the glue flies: gates and start in m and rad, north-east-down. */\n"
        f'#ifndef QUADJAX_POLICY_H\n#define QUADJAX_POLICY_H\n\n#include "{policy.name}.h"\n\n'
        f"{lines}\n\n#endif /* QUADJAX_POLICY_H */\n"
    )
