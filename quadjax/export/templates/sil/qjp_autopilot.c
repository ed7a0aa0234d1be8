/* The loader and the words of ${name}.qjp behind the messages. */
#include "${"qjp_pilot.h" if pilot else "qjp.h"}"
#include "qjp_data.h"
#include "message.h"

{% if pilot %}
static qjp_pilot pilot;
static qjp_counters before;

static void copy(float *to, const float *from, int count) {
  for (int i = 0; i < count; ++i) {
    to[i] = from[i];
  }
}

uint32_t sil_self_test(void) {
  return (qjp_pilot_load(&pilot, qjp_data, sizeof(qjp_data), ${rotor_speeds}U) != 0) ? 1U : 0U;
}

void sil_begin(void) {
  before = pilot.counters;
  qjp_pilot_reset(&pilot);
}

void sil_step(const sil_state *from, sil_command *to) {
  qjp_vehicle vehicle;
  copy(vehicle.position, from->position_ned_m, 3);
  copy(vehicle.velocity, from->velocity_ned_m_s, 3);
  copy(vehicle.euler, from->attitude_rpy_rad, 3);
  copy(vehicle.quaternion, from->quaternion_wxyz, 4);
  copy(vehicle.rates, from->rates_frd_rad_s, 3);
  copy(vehicle.rotor_speed, from->rotor_speed_rad_s, 4);
  qjp_pilot_step(&pilot, &vehicle, to->command);
  to->target_gate = pilot.race.target;
  to->nan_steps = pilot.counters.nan_steps - before.nan_steps;
  to->clipped_steps = pilot.counters.clipped_steps - before.clipped_steps;
  to->outside_steps = pilot.counters.outside_steps - before.outside_steps;
}
{% else %}
static qjp_policy policy;
static struct {
  int racing;
  qjp_race race;
  float command[QJP_COMMANDS];
  uint32_t nan_steps;
  uint32_t clipped_steps;
  uint32_t outside_steps;
} autopilot;

uint32_t sil_self_test(void) { return (uint32_t)qjp_load(&policy, qjp_data, sizeof(qjp_data)); }

void sil_begin(void) {
  static const float halfway[QJP_COMMANDS] = {${halfway | each("float32") | join(", ")}};
  autopilot.racing = 0;
  autopilot.nan_steps = autopilot.clipped_steps = autopilot.outside_steps = 0U;
  for (int i = 0; i < QJP_COMMANDS; ++i) {
    autopilot.command[i] = halfway[i];
  }
}

void sil_step(const sil_state *from, sil_command *to) {
  float state[QJP_MAX_STATE] = {0.0F};
  int32_t q[QJP_MAX_WIDTH];
  int32_t integers[QJP_COMMANDS];
  float rpm[4];
  for (int i = 0; i < 4; ++i) {
    rpm[i] = from->rotor_speed_rad_s[i] * ${rpm_per_rad_s | float32};
  }
  qjp_set(&policy, state, QJP_POSITION, from->position_ned_m);
  qjp_set(&policy, state, QJP_VELOCITY, from->velocity_ned_m_s);
  qjp_set(&policy, state, QJP_EULER, from->attitude_rpy_rad);
  qjp_set(&policy, state, QJP_QUATERNION, from->quaternion_wxyz);
  qjp_set(&policy, state, QJP_RATES, from->rates_frd_rad_s);
  qjp_set(&policy, state, QJP_ROTOR_SPEED, from->rotor_speed_rad_s);
  qjp_set(&policy, state, QJP_ROTOR_RPM, rpm);
  qjp_set(&policy, state, QJP_THRUST, &from->thrust_m_s2);
  qjp_set(&policy, state, QJP_MOMENT_EXT, from->moment_frd_n_m);
  qjp_set(&policy, state, QJP_FORCE_EXT, from->force_frd_m_s2);
  qjp_set(&policy, state, QJP_LAST_COMMAND, autopilot.command);
  if (!autopilot.racing) {
    qjp_race_start(&policy, &autopilot.race, from->position_ned_m, 0U);
    autopilot.racing = 1;
  }
  (void)qjp_race_update(&policy, &autopilot.race, from->position_ned_m);
  const qjp_status status = qjp_observe(&policy, state, autopilot.race.target, q);
  qjp_forward(&policy, q, integers, 0);
  qjp_commands(&policy, integers, autopilot.command);
  for (int i = 0; i < QJP_COMMANDS; ++i) {
    to->command[i] = autopilot.command[i]{% if rpm %} / ${rpm_per_rad_s | float32}{% endif %};
  }
  to->target_gate = autopilot.race.target;
  to->nan_steps = autopilot.nan_steps += (status.nan != 0U) ? 1U : 0U;
  to->clipped_steps = autopilot.clipped_steps += (status.clipped != 0U) ? 1U : 0U;
  to->outside_steps = autopilot.outside_steps += (status.outside != 0U) ? 1U : 0U;
}
{% endif %}
