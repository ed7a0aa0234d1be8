/* See nn_controller.h. */
#include "nn_controller.h"

#include "neural_network.h"
#include "qj_pilot.h"

const float gate_pos[NUM_GATES][3] = QUADJAX_GATE_POSITIONS;
const float gate_yaw[NUM_GATES] = QUADJAX_GATE_YAWS;
const float start_pos[3] = QUADJAX_START_POSITION;
const float start_yaw = QUADJAX_START_YAW;
uint8_t target_gate_index = 0U;

/* INDIflight's number of the motors front-left, front-right, rear-right, rear-left. */
static const uint8_t motor_number[4] = {3, 1, 0, 2};

static qj_pilot pilot;
static uint32_t tried;
static uint32_t now_us;

const char *nn_load(void) {
  tried = 1U;
  return qj_pilot_start(&pilot, &QUADJAX_POLICY, QJ_DEFAULT_KERNEL, (float)NN_CONTROL_HZ);
}

nn_counters_t nn_counters(void) {
  const qj_counters *const own = &pilot.counters;
  const nn_counters_t counters = {own->steps, own->nan_calls, own->outside_steps,
                                  pilot.race.passed, pilot.race.missed};
  return counters;
}

void nn_reset(void) {
  if (tried == 0U) {
    (void)nn_load();
  }
  qj_pilot_reset(&pilot);
  target_gate_index = 0U;
}

void nn_control(const float world_state[16], float motor_cmds[4]) {
  const float euler[3] = {world_state[6], world_state[7], world_state[8]};
  float commands[4];
  if (tried == 0U) {
    nn_reset();
  }
  now_us += 1000000U / NN_CONTROL_HZ;
  qj_vehicle vehicle = {.time_us = now_us, .position_us = now_us};
  for (uint32_t i = 0U; i < 3U; ++i) {
    vehicle.position[i] = world_state[i];
    vehicle.velocity[i] = world_state[3U + i];
    vehicle.rates[i] = world_state[9U + i];
  }
  for (uint32_t i = 0U; i < 4U; ++i) {
    vehicle.rotor_speed[i] = world_state[12U + motor_number[i]];
  }
  qj_quaternion_of(euler, vehicle.quaternion);
  (void)qj_pilot_call(&pilot, now_us, &vehicle, commands);
  for (uint32_t i = 0U; i < 4U; ++i) {
    motor_cmds[motor_number[i]] = commands[i];
  }
  target_gate_index = (uint8_t)pilot.race.target;
}

void nn_forward(const float *input, float *output) {
  int32_t q[QJ_MAX_WIDTH];
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    output[i] = 0.0F;
  }
  if (pilot.policy != 0) {
    (void)qj_quantize(pilot.policy, input, q);
    qj_act(pilot.policy, pilot.kernel, q, 0, output);
  }
}
