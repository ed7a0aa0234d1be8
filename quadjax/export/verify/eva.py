"""The C that Frama-C's EVA analyses: every emitted function, for any input and any memory."""

from pathlib import Path

from quadjax.export.estimator_tables import FINE_BITS
from quadjax.export.verify.folder import Folder


def write_eva_main(folder: Folder, work: Path) -> Path:
    """A main function that calls all of a folder's C and asserts what its outputs must be."""
    network, name = folder.network, folder.name
    unit = 2.0**network.fraction_bits
    motor = folder.policy.vehicle == "motor"
    low, high = network.command_low, network.command_high
    integers, commands = [], []
    for i in range(network.outputs):
        integers.append(f"  /*@ assert {low[i]} <= command[{i}] <= {high[i]}; */")
        ends = [x[i] / unit for x in (low, high)]
        bottom, top = (f"{x:.0f}" if motor else f"{x!r}" for x in map(float, ends))
        commands.append(f"  /*@ assert {bottom} <= out[{i}] <= {top}; */")
    estimator = folder.estimator is not None
    values = {
        "asserts": "\n".join(integers),
        "bounds": "\n".join(commands),
        "kind": "uint16_t" if motor else "float",
        "states": str(folder.race.state_size),
        "include": f'#include "{name}_estimator.h"' if estimator else "",
        "estimator": ESTIMATOR if estimator else "",
        "call": "  run_estimator();" if estimator else "",
        "memory": str(2**FINE_BITS),
    }
    text = MAIN.replace("<estimator>", values.pop("estimator"))
    for key, value in values.items():
        text = text.replace(f"<{key}>", value)
    path = work / "eva_main.c"
    path.write_text(text.replace("@name@", name).replace("@NAME@", name.upper()))
    return path


MAIN = """\
#include "__fc_builtin.h"
#include "@name@_race.h"
<include>

/* Any bits at all: NaN, infinities, everything. */
static float any_float(void) {
  union {
    float value;
    unsigned bits;
  } pun;
  pun.bits = Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU);
  return pun.value;
}

static int32_t any_integer(void) { return Frama_C_interval(-2147483647 - 1, 2147483647); }
static uint32_t any_unsigned(void) { return Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU); }

static void run_network(void) {
  float x[@NAME@_INPUTS];
  int32_t q[@NAME@_INPUTS];
  int32_t command[@NAME@_OUTPUTS];
  <kind> out[@NAME@_OUTPUTS];
  for (int i = 0; i < @NAME@_INPUTS; ++i) {
    q[i] = any_integer();
  }
  @name@_forward_q(q, command);
<asserts>
  @name@_command(command, out);
<bounds>
  for (int i = 0; i < @NAME@_INPUTS; ++i) {
    x[i] = any_float();
  }
  (void)@name@_quantize(x, q);
  for (int i = 0; i < @NAME@_INPUTS; ++i) {
    /*@ assert -@NAME@_INPUT_ONE <= q[i] <= @NAME@_INPUT_ONE; */
  }
}

/* The race from any memory of it. */
static void run_race(void) {
  @name@_state state;
  @name@_race race;
  int32_t q[@NAME@_INPUTS];
  <kind> out[@NAME@_OUTPUTS];
  @name@_event event;
  float *const numbers = (float *)&state;
  for (int i = 0; i < <states>; ++i) {
    numbers[i] = any_float();
  }
  @name@_race_start(&race, state.position, any_unsigned());
  for (int i = 0; i < 3; ++i) {
    race.previous[i] = any_integer();
  }
  race.target = any_unsigned();
  race.passed = any_unsigned();
  race.missed = any_unsigned();
  (void)@name@_observe(&state, any_unsigned(), q);
  for (int i = 0; i < @NAME@_INPUTS; ++i) {
    /*@ assert -@NAME@_INPUT_ONE <= q[i] <= @NAME@_INPUT_ONE; */
  }
  (void)@name@_race_step(&race, @NAME@_SCALAR, &state, out, &event);
  /*@ assert race.target < @NAME@_GATES; */
<bounds>
}
<estimator>
void eva_main(void);
void eva_main(void) {
  run_network();
  run_race();
<call>
}
"""
ESTIMATOR = """
/* A sample from any memory that the filters can have: the converter has proven their outputs to
 * stay below <memory>. The first number of a filter's memory is its next output should all inputs
 * be zero, so below that too; the second is at most twice as much. */
static void run_estimator(void) {
  @name@_measurement m;
  @name@_estimator estimator;
  float moment[3];
  float force[3];
  float *const numbers = (float *)&m;
  for (int i = 0; i < 13; ++i) {
    numbers[i] = any_float();
  }
  for (int i = 0; i < 6; ++i) {
    estimator.s1[i] = Frama_C_long_long_interval(-<memory>LL, <memory>LL);
    estimator.s2[i] = Frama_C_long_long_interval(-2LL * <memory>LL, 2LL * <memory>LL);
  }
  estimator.started = any_unsigned();
  (void)@name@_estimator_update(&estimator, &m, moment, force);
}
"""
