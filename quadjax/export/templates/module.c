/*
 * ${name}_module: see ${name}_module.h.
 *
${origin.lines | comment}
 *
 * The only file that knows Paparazzi: what it reads from the state interface, what it tells the
 * ground. Everything that computes is in the files beside it.
 */
#include "modules/${name}/${name}_module.h"

#include <sys/auxv.h>

#include "autopilot.h"
#include "modules/core/abi.h"
#include "modules/datalink/telemetry.h"
#include "state.h"
#if defined(PREFLIGHT_CHECKS) && PREFLIGHT_CHECKS
#include "modules/checks/preflight_checks.h"
#endif
{% if rpm %}
#include "boards/bebop/actuators.h"

#include "modules/${name}/${name}_estimator.h"
{% if battery %}
#include "modules/${name}/${name}_battery.h"
{% endif %}
{% else %}

{% endif %}
#include "modules/${name}/${name}_race.h"

#ifndef HWCAP_NEON
#define HWCAP_NEON (1UL << 12)
#endif

/* Motors in the order front-left, front-right, rear-right, rear-left. */
#ifndef ${NAME}_MOTORS
#define ${NAME}_MOTORS {0, 1, 2, 3}
#endif

uint8_t ${name}_module_enable = 1;

/* Counters of what was wrong with the inputs, and the last of it, for the ground. */
struct ${name}_log {
  uint32_t steps;
  uint32_t clipped_steps;
  uint32_t nan_steps;
  uint32_t outside_steps;
{% if estimator %}
  uint32_t estimator_steps; /* in which a measurement was clipped or not a number */
{% endif %}
{% if battery %}
  uint32_t battery_steps;   /* likewise, a speed or a command */
  float highest_rpm;        /* the estimate */
{% endif %}
  ${name}_race_status last;
};

static struct {
  uint32_t mismatches;
  bool flying;
{% if hold > 1 %}
  uint32_t calls; /* since the last step of the policy */
{% endif %}
  ${name}_kernel kernel;
  ${name}_race race;
{% if estimator %}
  ${name}_estimator estimator;
{% endif %}
{% if battery %}
  ${name}_battery battery;
{% endif %}
  ${command_type} command[${NAME}_OUTPUTS];
  struct ${name}_log log;
} module;

/* ---- what the autopilot knows ------------------------------------------------------------------ */

static void read_state(${name}_state *state) {
  const struct NedCoor_f *const position = stateGetPositionNed_f();
  const struct NedCoor_f *const velocity = stateGetSpeedNed_f();
{% if "euler" in known %}
  const struct FloatEulers *const euler = stateGetNedToBodyEulers_f();
{% endif %}
{% if "quaternion" in known %}
  const struct FloatQuat *const quaternion = stateGetNedToBodyQuat_f();
{% endif %}
  const struct FloatRates *const rates = stateGetBodyRates_f();
  state->position[0] = position->x;
  state->position[1] = position->y;
  state->position[2] = position->z;
  state->velocity[0] = velocity->x;
  state->velocity[1] = velocity->y;
  state->velocity[2] = velocity->z;
{% if "euler" in known %}
  state->euler[0] = euler->phi;
  state->euler[1] = euler->theta;
  state->euler[2] = euler->psi;
{% endif %}
{% if "quaternion" in known %}
  state->quaternion[0] = quaternion->qi;
  state->quaternion[1] = quaternion->qx;
  state->quaternion[2] = quaternion->qy;
  state->quaternion[3] = quaternion->qz;
{% endif %}
  state->rates[0] = rates->p;
  state->rates[1] = rates->q;
  state->rates[2] = rates->r;
{% if rpm %}
  static const uint8_t motor[4] = ${NAME}_MOTORS;
  for (uint32_t i = 0U; i < 4U; ++i) {
    state->rpm[i] = (float)actuators_bebop.rpm_obs[motor[i]];
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    state->moment_ext[i] = 0.0f;
    state->force_ext[i] = 0.0f;
  }
{% else %}
  const struct Int32Vect3 *const acceleration = stateGetAccelBody_i();
  /* Specific thrust is what the accelerometer feels along body -z. */
  state->thrust = -ACCEL_FLOAT_OF_BFP(acceleration->z);
{% endif %}
{% if "last_command" in known %}
  static const float halfway[${NAME}_OUTPUTS] = {${halfway | join(", ")}};
  for (uint32_t i = 0U; i < ${NAME}_OUTPUTS; ++i) {
    state->last_command[i] = module.flying ? (float)module.command[i] : halfway[i];
  }
{% endif %}
}

{% if estimator %}
/* The accelerometer less its bias, in the body frame. */
static void estimate(${name}_state *state) {
  ${name}_measurement m;
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
  const ${name}_estimator_status status =
      ${name}_estimator_update(&module.estimator, &m, state->moment_ext, state->force_ext);
  if (module.flying && ((status.clipped | status.nan) != 0U)) {
    ++module.log.estimator_steps;
  }
}

{% endif %}
{% if battery %}
/* The highest propeller speed, from measured speeds and the commands of the call before: of the
 * policy, or else of the autopilot. */
static void estimate_highest(${name}_state *state) {
  static const uint8_t motor[4] = ${NAME}_MOTORS;
  ${name}_battery_sample sample;
  for (uint32_t i = 0U; i < 4U; ++i) {
    sample.rpm[i] = state->rpm[i];
    sample.command[i] = module.flying ? (float)module.command[i]
                                      : (float)actuators_bebop.rpm_ref[motor[i]];
  }
  const ${name}_battery_status status =
      ${name}_battery_update(&module.battery, &sample, &state->highest_rpm);
  module.log.highest_rpm = state->highest_rpm;
  if (module.flying && ((status.clipped | status.nan) != 0U)) {
    ++module.log.battery_steps;
  }
}

{% endif %}
/* ---- the ground --------------------------------------------------------------------------------- */

#if defined(PERIODIC_TELEMETRY) && PERIODIC_TELEMETRY
static void send_status(struct transport_tx *trans, struct link_device *dev) {
  float values[] = {(float)module.mismatches,          (float)module.flying,
                    (float)module.kernel,              (float)module.race.target,
                    (float)module.race.passed,         (float)module.race.missed,
                    (float)module.log.steps,           (float)module.log.clipped_steps,
                    (float)module.log.nan_steps,       (float)module.log.outside_steps,
                    (float)module.log.last.clipped,    (float)module.log.last.nan,
                    (float)module.log.last.outside${"," if estimator else "};"}
{% if estimator %}
                    (float)module.log.estimator_steps${"," if battery else "};"}
{% endif %}
{% if battery %}
                    (float)module.log.battery_steps,   module.log.highest_rpm};
{% endif %}
  pprz_msg_send_PAYLOAD_FLOAT(trans, dev, AC_ID, (uint8_t)(sizeof(values) / sizeof(values[0])),
                              values);
}
#endif

#if defined(PREFLIGHT_CHECKS) && PREFLIGHT_CHECKS
static struct preflight_check_t self_test_check;

static void check_self_test(struct preflight_result_t *result) {
  if (module.mismatches != 0U) {
    preflight_error(result, "${name}: %u self-test mismatches", (unsigned)module.mismatches);
  } else {
    preflight_success(result, "${name}: self-test passed");
  }
}
#endif

/* ---- the module --------------------------------------------------------------------------------- */

void ${name}_module_init(void) {
  const float origin[3] = {0.0f, 0.0f, 0.0f};
  module.kernel = (getauxval(AT_HWCAP) & HWCAP_NEON) ? ${NAME}_NEON : ${NAME}_SCALAR;
  module.mismatches = ${name}_self_test_with(${NAME}_SCALAR);
  module.mismatches += ${name}_self_test_with(module.kernel);
  module.mismatches += ${name}_race_self_test();
{% if estimator %}
  module.mismatches += ${name}_estimator_self_test();
{% endif %}
{% if battery %}
  module.mismatches += ${name}_battery_self_test();
{% endif %}
  module.flying = false;
  ${name}_race_start(&module.race, origin, 0U);
#if defined(PREFLIGHT_CHECKS) && PREFLIGHT_CHECKS
  preflight_check_register(&self_test_check, check_self_test);
#endif
#if defined(PERIODIC_TELEMETRY) && PERIODIC_TELEMETRY
  register_periodic_telemetry(DefaultPeriodic, PPRZ_MSG_ID_PAYLOAD_FLOAT, send_status);
#endif
}

uint32_t ${name}_module_mismatches(void) { return module.mismatches; }

static void log_status(${name}_race_status status) {
  ++module.log.steps;
  module.log.clipped_steps += (status.clipped != 0U) ? 1U : 0U;
  module.log.nan_steps += (status.nan != 0U) ? 1U : 0U;
  module.log.outside_steps += (status.outside != 0U) ? 1U : 0U;
  module.log.last = status;
}

void ${name}_module_periodic(void) {
  ${name}_state state;
  const bool wanted = (autopilot_get_mode() == ${NAME}_MODE) && (${name}_module_enable != 0U);
  if (module.mismatches != 0U) {
    /* Refuse to arm: whoever arms is disarmed within one period. */
    module.flying = false;
    autopilot_set_motors_on(false);
    return;
  }
  read_state(&state);
{% if estimator %}
  estimate(&state);
{% endif %}
{% if battery %}
  estimate_highest(&state);
{% endif %}
  if (wanted && !module.flying) {
    ${name}_race_start(&module.race, state.position, 0U);
{% if hold > 1 %}
    module.calls = 0U;
{% endif %}
  }
  module.flying = wanted;
{% if hold > 1 %}
  /* The policy observes earlier steps, of ${race.time_step | number} s. */
  const bool due = (module.calls == 0U);
  module.calls = (module.calls + 1U < ${hold}U) ? module.calls + 1U : 0U;
  if (wanted && due) {
{% else %}
  if (wanted) {
{% endif %}
    log_status(${name}_race_step(&module.race, module.kernel, &state, module.command, 0));
  }
}

bool ${name}_module_command(${command_type} command[4]) {
  if (!module.flying || (module.mismatches != 0U)) {
    return false;
  }
{% if rpm %}
  static const uint8_t motor[4] = ${NAME}_MOTORS;
  for (uint32_t i = 0U; i < 4U; ++i) {
    command[motor[i]] = module.command[i];
  }
{% else %}
  for (uint32_t i = 0U; i < 4U; ++i) {
    command[i] = module.command[i];
  }
{% endif %}
  return true;
}
