/* What the tests call. */
#include "controller.h"
#include "debug.h"
#include "task.h"

void stub_step(const float *in, int enabled, uint32_t step, float *motors);

void vTaskDelay(uint32_t ticks) { (void)ticks; }
void stub_print(const char *format, ...) { (void)format; }

/* in: position, velocity, quaternion w x y z, gyro in deg/s; all in the firmware's axes. */
void stub_step(const float *in, int enabled, uint32_t step, float *motors) {
  const setpoint_t setpoint = {{modeAbs, modeAbs, enabled ? modeAbs : modeDisable}};
  const sensorData_t sensors = {{0.0F, 0.0F, 1.0F}, {in[10], in[11], in[12]}};
  const state_t state = {{0U, in[7], in[8], in[9], in[6]},
                         {0U, in[0], in[1], in[2]},
                         {0U, in[3], in[4], in[5]}};
  control_t control = {{-1.0F, -1.0F, -1.0F, -1.0F}, controlModeLegacy};
  controllerOutOfTree(&control, &setpoint, &sensors, &state, step);
  for (uint32_t i = 0U; i < 4U; ++i) {
    motors[i] = (control.controlMode == controlModeForce) ? control.normalizedForces[i] : -2.0F;
  }
}
