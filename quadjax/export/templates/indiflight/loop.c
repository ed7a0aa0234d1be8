/* nn_control for many drones: the controller of each is copied in and out. Not for flight. */
#include "nn_controller.c"

uint32_t loop_size(void);
void loop_begin(unsigned char *memory, const float *world, const uint32_t *target, uint32_t count);
void loop_step(unsigned char *memory, const float *world, float *command, uint32_t count);

static void copy(unsigned char *to, const unsigned char *from) {
  for (uint32_t i = 0U; i < sizeof(controller); ++i) {
    to[i] = from[i];
  }
}

uint32_t loop_size(void) { return sizeof(controller); }

/* Races that have begun at positions, each with a target. */
void loop_begin(unsigned char *memory, const float *world, const uint32_t *target, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    nn_reset();
    ${name}_race_start(&controller.race, world + 16U * i, target[i]);
    controller.racing = true;
    copy(memory + sizeof(controller) * i, (const unsigned char *)&controller);
  }
}

void loop_step(unsigned char *memory, const float *world, float *command, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    copy((unsigned char *)&controller, memory + sizeof(controller) * i);
    for (uint32_t call = 0U; call < (uint32_t)NN_STEP_CALLS; ++call) { /* one step of the policy */
      nn_control(world + 16U * i, command + 4U * i);
    }
    copy(memory + sizeof(controller) * i, (const unsigned char *)&controller);
  }
}
