/*
 * ${name} for INDIflight: see nn_controller.h. The text below is the exported ${name}_race.h and
 * ${name}_race.c; INDIflight's functions follow it.
 */
#include "nn_controller.h"

#include "neural_network.h"

${race_header}
${race_source}
/* ---- INDIflight --------------------------------------------------------------------------------- */
{% set fields = race.fields | map(attribute="name") | list %}
{% if "quaternion" in fields %}

/* Of the C library. */
float sinf(float x);
float cosf(float x);
{% endif %}

const float gate_pos[NUM_GATES][3] = {
${rows(gate_positions, "float32")}};
const float gate_yaw[NUM_GATES] = {
${gate_yaws | each("float32") | wrapped}};
const float start_pos[3] = {${start_position | each("float32") | join(", ")}};
const float start_yaw = ${start_yaw | float32};

uint8_t target_gate_index = 0U;

/* INDIflight's number of the policy's motors front-left, front-right, rear-right, rear-left. */
static const uint8_t motor_number[4] = {${motors | join(", ")}};

enum { POSITION = 0, VELOCITY = 3, EULER = 6, RATES = 9, ROTORS = 12 };

static struct {
  bool tested;
  bool racing; /* since the first nn_control after nn_reset */
  uint32_t mismatches;
{% if race.box.layout.counts_steps %}
  uint32_t calls; /* since the last step of the policy */
{% endif %}
  ${name}_race race;
  float command[4]; /* of the step before, in the policy's order */
  nn_counters_t counters;
} controller;

uint32_t nn_self_test(void) {
  controller.mismatches = ${name}_self_test() + ${name}_race_self_test();
  controller.tested = true;
  return controller.mismatches;
}

nn_counters_t nn_counters(void) {
  nn_counters_t counters = controller.counters;
  counters.gates_passed = controller.race.passed;
  counters.gates_missed = controller.race.missed;
  return counters;
}

void nn_reset(void) {
  static const float halfway[4] = {${halfway | each("float32") | join(", ")}};
  if (!controller.tested) {
    (void)nn_self_test();
  }
  for (uint32_t i = 0U; i < 4U; ++i) {
    controller.command[i] = halfway[i];
  }
  controller.racing = false;
  target_gate_index = 0U;
}

{% if "quaternion" in fields %}
/* Yaw, then pitch, then roll. */
static void quaternion_of(const float euler[3], float q[4]) {
  const float cr = cosf(0.5F * euler[0]);
  const float sr = sinf(0.5F * euler[0]);
  const float cp = cosf(0.5F * euler[1]);
  const float sp = sinf(0.5F * euler[1]);
  const float cy = cosf(0.5F * euler[2]);
  const float sy = sinf(0.5F * euler[2]);
  q[0] = cr * cp * cy + sr * sp * sy;
  q[1] = sr * cp * cy - cr * sp * sy;
  q[2] = cr * sp * cy + sr * cp * sy;
  q[3] = cr * cp * sy - sr * sp * cy;
}

{% endif %}
static void read_state(const float world_state[16], ${name}_state *state) {
  for (uint32_t i = 0U; i < 3U; ++i) {
    state->position[i] = world_state[POSITION + i];
    state->velocity[i] = world_state[VELOCITY + i];
{% if "euler" in fields %}
    state->euler[i] = world_state[EULER + i];
{% endif %}
    state->rates[i] = world_state[RATES + i];
  }
  for (uint32_t i = 0U; i < 4U; ++i) {
    state->rotor_speed[i] = world_state[ROTORS + motor_number[i]];
{% if "last_command" in fields %}
    state->last_command[i] = controller.command[i];
{% endif %}
  }
{% if "quaternion" in fields %}
  quaternion_of(&world_state[EULER], state->quaternion);
{% endif %}
}

static void count(${name}_race_status status) {
  ++controller.counters.steps;
  controller.counters.nan_steps += (status.nan != 0U) ? 1U : 0U;
  controller.counters.clipped_steps += (status.clipped != 0U) ? 1U : 0U;
  controller.counters.outside_steps += (status.outside != 0U) ? 1U : 0U;
}

void nn_control(const float world_state[16], float motor_cmds[4]) {
  ${name}_state state;
  if (!controller.tested) {
    nn_reset();
  }
  if (controller.mismatches != 0U) {
    for (uint32_t i = 0U; i < 4U; ++i) {
      motor_cmds[i] = 0.0F;
    }
    return;
  }
  read_state(world_state, &state);
  if (!controller.racing) {
    ${name}_race_start(&controller.race, state.position, 0U);
    controller.racing = true;
{% if race.box.layout.counts_steps %}
    controller.calls = 0U;
  }
  if (controller.calls == 0U) {
    count(${name}_race_step(&controller.race, ${NAME}_SCALAR, &state, controller.command, 0));
  }
  controller.calls = (controller.calls + 1U < (uint32_t)NN_STEP_CALLS) ? controller.calls + 1U : 0U;
{% else %}
  }
  count(${name}_race_step(&controller.race, ${NAME}_SCALAR, &state, controller.command, 0));
{% endif %}
  for (uint32_t i = 0U; i < 4U; ++i) {
    motor_cmds[motor_number[i]] = controller.command[i];
  }
  target_gate_index = (uint8_t)controller.race.target;
}
