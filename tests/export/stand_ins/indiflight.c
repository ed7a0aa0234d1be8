/* A stand-in for INDIflight around the glue. */
#include "firmware.h"

#include "nn_controller.c"

const char *firmware_start(void) { return nn_load(); }

uint32_t firmware_call(uint32_t now_us, const qj_vehicle *vehicle, uint32_t flies,
                       float command[QJ_COMMANDS]) {
  float world_state[16];
  float euler[3] = {0.0F, 0.0F, 0.0F};
  float motors[4] = {0.0F, 0.0F, 0.0F, 0.0F};
  (void)now_us;
  if (vehicle != 0) {
    qj_euler_of(vehicle->quaternion, euler);
  }
  for (uint32_t i = 0U; (vehicle != 0) && (i < 3U); ++i) {
    world_state[i] = vehicle->position[i];
    world_state[3U + i] = vehicle->velocity[i];
    world_state[6U + i] = euler[i];
    world_state[9U + i] = vehicle->rates[i];
  }
  for (uint32_t i = 0U; (vehicle != 0) && (i < 4U); ++i) {
    world_state[12U + motor_number[i]] = vehicle->rotor_speed[i];
  }
  if (flies == 0U) {
    nn_reset();
  } else if (vehicle != 0) {
    nn_control(world_state, motors);
  }
  for (uint32_t i = 0U; i < 4U; ++i) {
    command[i] = motors[motor_number[i]];
  }
  return (pilot.policy != 0) ? 1U : 0U;
}

qj_pilot *firmware_pilot(void) { return &pilot; }
