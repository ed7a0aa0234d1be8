/* See nn_controller.h. */
#include "nn_controller.h"

#include "neural_network.h"
#include "qj_pilot.h"

#define NN_CALL_NS (1000000000U / NN_CONTROL_HZ)

const float gate_pos[NUM_GATES][3] = QUADJAX_GATE_POSITIONS;
const float gate_yaw[NUM_GATES] = QUADJAX_GATE_YAWS;
const float start_pos[3] = QUADJAX_START_POSITION;
const float start_yaw = QUADJAX_START_YAW;
uint8_t target_gate_index = 0U;

/* INDIflight's number of the motors front-left, front-right, rear-right, rear-left. */
static const uint8_t motor_number[4] = {3, 1, 0, 2};

static qj_pilot pilot;
static const char *wrong = "not loaded";
static uint32_t tried;
static uint32_t now_us;

const char *nn_load(void) {
  static const qj_interface interface = {
      QJ_GIVES(QJ_EULER) | QJ_GIVES(QJ_QUATERNION) | QJ_GIVES(QJ_ROTOR_SPEED), QJ_GIVES(QJ_MOTOR),
      NN_CALL_NS};
  wrong = qj_pilot_load(&pilot, QUADJAX_WORDS, sizeof(QUADJAX_WORDS), &interface);
  tried = 1U;
  return wrong;
}

nn_counters_t nn_counters(void) {
  const qj_counters *const own = &pilot.counters;
  const nn_counters_t counters = {own->steps,         own->nan_steps,    own->clipped_steps,
                                  own->outside_steps, pilot.race.passed, pilot.race.missed};
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
  qj_vehicle vehicle;
  float commands[4];
  if (tried == 0U) {
    nn_reset();
  }
  now_us += NN_CALL_NS / 1000U;
  vehicle.time_us = now_us;
  for (uint32_t i = 0U; i < 3U; ++i) {
    vehicle.position[i] = world_state[i];
    vehicle.velocity[i] = world_state[3U + i];
    vehicle.euler[i] = world_state[6U + i];
    vehicle.rates[i] = world_state[9U + i];
  }
  for (uint32_t i = 0U; i < 4U; ++i) {
    vehicle.rotor_speed[i] = world_state[12U + motor_number[i]];
    vehicle.others_command[i] = 0.0F;
  }
#if QUADJAX_OBSERVES_QUATERNION
  qj_quaternion_of(vehicle.euler, vehicle.quaternion);
#endif
  (void)qj_pilot_step(&pilot, now_us, &vehicle, commands);
  for (uint32_t i = 0U; i < 4U; ++i) {
    motor_cmds[motor_number[i]] = commands[i];
  }
  target_gate_index = (uint8_t)pilot.race.target;
}

void nn_forward(const float *input, float *output) {
  int32_t q[QJ_MAX_WIDTH];
  int32_t command[QJ_COMMANDS];
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    output[i] = 0.0F;
  }
  if ((tried != 0U) && (wrong == 0)) {
    (void)qj_quantize(&pilot.policy, input, q);
    qj_forward(&pilot.policy, q, command, 0);
    qj_commands(&pilot.policy, command, output);
  }
}
