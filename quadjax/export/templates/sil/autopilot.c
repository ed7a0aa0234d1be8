/* The exported C of ${name} behind the messages. */
{% if indiflight %}
#include "nn_controller.h"
{% else %}
#include "${name}_race.h"
{% if own_estimator %}
#include "${name}_estimator.h"
{% endif %}
{% if battery %}
#include "${name}_battery.h"
{% endif %}
{% endif %}
#include "message.h"

static void copy(float *to, const float *from, int count) {
  for (int i = 0; i < count; ++i) {
    to[i] = from[i];
  }
}
{% if indiflight %}

/* INDIflight's number of the motors front-left, front-right, rear-right, rear-left. */
static const int motor_number[4] = {${motors | join(", ")}};
static nn_counters_t before;

uint32_t sil_self_test(void) { return nn_self_test(); }

void sil_begin(void) {
  before = nn_counters();
  nn_reset();
}

void sil_step(const sil_state *from, sil_command *to) {
  float world[16];
  float motors[4];
  copy(world, from->position_ned_m, 3);
  copy(world + 3, from->velocity_ned_m_s, 3);
  copy(world + 6, from->attitude_rpy_rad, 3);
  copy(world + 9, from->rates_frd_rad_s, 3);
  for (int i = 0; i < 4; ++i) {
    world[12 + motor_number[i]] = from->rotor_speed_rad_s[i];
  }
  nn_control(world, motors);
  for (int i = 0; i < 4; ++i) {
    to->command[i] = motors[motor_number[i]];
  }
  const nn_counters_t now = nn_counters();
  to->target_gate = target_gate_index;
  to->nan_steps = now.nan_steps - before.nan_steps;
  to->clipped_steps = now.clipped_steps - before.clipped_steps;
  to->outside_steps = now.outside_steps - before.outside_steps;
}
{% else %}

static struct {
  int racing;
  ${name}_race race;
{% if own_estimator %}
  ${name}_estimator estimator;
{% endif %}
{% if battery %}
  ${name}_battery battery;
{% endif %}
  float command[4];
  uint32_t nan_steps;
  uint32_t clipped_steps;
  uint32_t outside_steps;
} autopilot;

uint32_t sil_self_test(void) {
  return ${name}_self_test() + ${name}_race_self_test(){% if own_estimator %} + ${name}_estimator_self_test(){% endif %}{% if battery %} + ${name}_battery_self_test(){% endif %};
}

void sil_begin(void) {
  static const float halfway[4] = {${halfway | each("float32") | join(", ")}};
  autopilot.racing = 0;
{% if own_estimator %}
  autopilot.estimator = (${name}_estimator){{0}, {0}, 0U};
{% endif %}
{% if battery %}
  ${name}_battery_reset(&autopilot.battery);
{% endif %}
  copy(autopilot.command, halfway, 4);
  autopilot.nan_steps = autopilot.clipped_steps = autopilot.outside_steps = 0U;
}

void sil_step(const sil_state *from, sil_command *to) {
  ${name}_state state;
  ${command_type} command[${NAME}_OUTPUTS];
  copy(state.position, from->position_ned_m, 3);
  copy(state.velocity, from->velocity_ned_m_s, 3);
{% if "euler" in fields %}
  copy(state.euler, from->attitude_rpy_rad, 3);
{% endif %}
{% if "quaternion" in fields %}
  copy(state.quaternion, from->quaternion_wxyz, 4);
{% endif %}
  copy(state.rates, from->rates_frd_rad_s, 3);
{% if "thrust" in fields %}
  state.thrust = from->thrust_m_s2;
{% endif %}
{% if "rotor_speed" in fields %}
  copy(state.rotor_speed, from->rotor_speed_rad_s, 4);
{% endif %}
{% if "rpm" in fields %}
  for (int i = 0; i < 4; ++i) {
    state.rpm[i] = from->rotor_speed_rad_s[i] * ${rpm_per_rad_s | float32};
  }
{% endif %}
{% if "moment_ext" in fields %}
{% if own_estimator %}
  ${name}_measurement measured;
  copy(measured.gyro, from->gyro_frd_rad_s, 3);
  copy(measured.specific_force, from->specific_force_frd_m_s2, 3);
  copy(measured.rpm, state.rpm, 4);
  copy(measured.velocity, from->velocity_frd_m_s, 3);
  (void)${name}_estimator_update(&autopilot.estimator, &measured, state.moment_ext,
                                 state.force_ext);
{% else %}
  copy(state.moment_ext, from->moment_frd_n_m, 3);
  copy(state.force_ext, from->force_frd_m_s2, 3);
{% endif %}
{% endif %}
{% if battery %}
  ${name}_battery_sample sample;
  copy(sample.rpm, state.rpm, 4);
  copy(sample.command, autopilot.command, 4);
  (void)${name}_battery_update(&autopilot.battery, &sample, &state.highest_rpm);
{% endif %}
{% if "last_command" in fields %}
  copy(state.last_command, autopilot.command, 4);
{% endif %}
  if (!autopilot.racing) {
    ${name}_race_start(&autopilot.race, state.position, 0U);
    autopilot.racing = 1;
  }
  const ${name}_race_status status =
      ${name}_race_step(&autopilot.race, ${NAME}_DEFAULT_KERNEL, &state, command, 0);
  for (int i = 0; i < 4; ++i) {
    autopilot.command[i] = (float)command[i];
    to->command[i] = (float)command[i]{% if rpm %} / ${rpm_per_rad_s | float32}{% endif %};
  }
  to->target_gate = autopilot.race.target;
  to->nan_steps = autopilot.nan_steps += (status.nan != 0U) ? 1U : 0U;
  to->clipped_steps = autopilot.clipped_steps += (status.clipped != 0U) ? 1U : 0U;
  to->outside_steps = autopilot.outside_steps += (status.outside != 0U) ? 1U : 0U;
}
{% endif %}
