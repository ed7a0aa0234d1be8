"""The emitted Paparazzi module: its XML and the glue between the autopilot and the policy."""

from quadjax.export.emit_network import Provenance
from quadjax.export.fixed import FixedNetwork
from quadjax.export.render import comment, fill

FREQUENCY = 512

READ_RPM = """\
  static const uint8_t motor[4] = @NAME@_MOTORS;
  for (uint32_t i = 0U; i < 4U; ++i) {
    state->rpm[i] = (float)actuators_bebop.rpm_obs[motor[i]];
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    state->moment_ext[i] = 0.0f;
    state->force_ext[i] = 0.0f;
  }"""
READ_THRUST = """\
  const struct Int32Vect3 *const acceleration = stateGetAccelBody_i();
  /* Specific thrust is what the accelerometer feels along body -z. */
  state->thrust = -ACCEL_FLOAT_OF_BFP(acceleration->z);"""
ESTIMATE = """\
/* The accelerometer less its bias, in the body frame. */
static void estimate(@name@_state *state) {
  @name@_measurement m;
  struct FloatVect3 body_velocity;
  const struct FloatVect3 velocity = {state->velocity[0], state->velocity[1], state->velocity[2]};
  const struct Int32Vect3 *const acceleration = stateGetAccelBody_i();
  float_rmat_vmult(&body_velocity, stateGetNedToBodyRMat_f(), &velocity);
  m.specific_force[0] = ACCEL_FLOAT_OF_BFP(acceleration->x);
  m.specific_force[1] = ACCEL_FLOAT_OF_BFP(acceleration->y);
  m.specific_force[2] = ACCEL_FLOAT_OF_BFP(acceleration->z);
  m.velocity[0] = body_velocity.x;
  m.velocity[1] = body_velocity.y;
  m.velocity[2] = body_velocity.z;
  for (uint32_t i = 0U; i < 3U; ++i) {
    m.gyro[i] = state->rates[i];
  }
  for (uint32_t i = 0U; i < 4U; ++i) {
    m.rpm[i] = state->rpm[i];
  }
  const @name@_estimator_status status =
      @name@_estimator_update(&module.estimator, &m, state->moment_ext, state->force_ext);
  if (module.flying && ((status.clipped | status.nan) != 0U)) {
    ++module.log.estimator_steps;
  }
}
"""
ESTIMATOR_COUNTER = """\
  uint32_t estimator_steps; /* in which a measurement was clipped or not a number */
"""
ESTIMATOR_VALUE = """,
                    (float)module.log.estimator_steps"""
GIVE_RPM = """\
  static const uint8_t motor[4] = @NAME@_MOTORS;
  for (uint32_t i = 0U; i < 4U; ++i) {
    command[motor[i]] = module.command[i];
  }"""
GIVE_RATES = """\
  for (uint32_t i = 0U; i < 4U; ++i) {
    command[i] = module.command[i];
  }"""


def emit_paparazzi(network: FixedNetwork, origin: Provenance) -> dict[str, str]:
    """The module's files, by path under ``paparazzi/``."""
    name, values = origin.name, _values(network, origin)
    return {
        f"paparazzi/{name}.xml": fill("module.xml.in", values),
        f"paparazzi/{name}_module.h": fill("module.h.in", values),
        f"paparazzi/{name}_module.c": fill("module.c.in", values),
    }


def _values(network: FixedNetwork, origin: Provenance) -> dict[str, str]:
    """What the templates' fields become."""
    motor = network.vehicle == "motor"
    names = {"name": origin.name, "NAME": origin.name.upper()}

    def named(text: str) -> str:
        return text.replace("@name@", names["name"]).replace("@NAME@", names["NAME"])

    parts = ["", "_race", "_module", *(["_estimator"] if motor else [])]
    return names | {
        "provenance": comment(origin.lines),
        "frequency": str(FREQUENCY),
        "file_list": "\n".join(
            f'    <file name="{origin.name}{part}.c"/>' for part in sorted(parts)
        ),
        "command_type": "uint16_t" if motor else "float",
        "command_comment": (
            "rpm, in the order of the board's motors"
            if motor
            else "p, q, r in rad/s and specific thrust in m/s^2"
        ),
        "override_comment": (
            "Call it at the top of actuators_bebop_commit() with actuators_bebop.rpm_ref."
            if motor
            else "Give them to the inner loop in place of the stick's."
        ),
        "board_include": '#include "boards/bebop/actuators.h"\n' if motor else "",
        "estimator_include": (
            named('#include "modules/@name@/@name@_estimator.h"\n') if motor else ""
        ),
        "estimator_member": named("  @name@_estimator estimator;\n") if motor else "",
        "estimator_counter": ESTIMATOR_COUNTER if motor else "",
        "estimator_value": ESTIMATOR_VALUE if motor else "",
        "read_actuators": named(READ_RPM if motor else READ_THRUST),
        "estimate": named(ESTIMATE) if motor else "",
        "estimate_call": "  estimate(&state);\n" if motor else "",
        "estimator_self_test": (
            named("  module.mismatches += @name@_estimator_self_test();\n") if motor else ""
        ),
        "give_command": named(GIVE_RPM if motor else GIVE_RATES),
    }
