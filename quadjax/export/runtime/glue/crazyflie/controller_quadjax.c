/*
 * A quadjax policy as the out-of-tree controller of a Crazyflie. NOT TESTED ON HARDWARE: compiled
 * against stand-ins of the firmware's headers. The policy is quadjax_policy.h; this file is the same for
 * every policy.
 */
#include <stdbool.h>
#include <stdint.h>

#include "FreeRTOS.h"
#include "app.h"
#include "controller.h"
#include "debug.h"
#include "log.h"
#include "qj_pilot.h"
#include "quadjax_policy.h"
#include "task.h"

#define RAD_PER_DEG 0.017453292519943295F
#define US_PER_TICK 1000U /* of the stabilizer, 1 kHz */

/* Places of M1 .. M4: front-right, rear-right, rear-left, front-left. */
static const uint8_t place_of_motor[4] = {QJ_FRONT_RIGHT, QJ_REAR_RIGHT, QJ_REAR_LEFT,
                                          QJ_FRONT_LEFT};

static qj_pilot pilot;
static const char *wrong = "not loaded";
static float motors[4];

static uint8_t target;
static uint32_t nan_steps;
static uint32_t clipped_steps;

void appMain(void) {
  for (;;) {
    vTaskDelay(M2T(1000));
  }
}

void controllerOutOfTreeInit(void) {
  const qj_interface interface = {QJ_GIVES(QJ_EULER) | QJ_GIVES(QJ_QUATERNION), QJ_GIVES(QJ_MOTOR),
                                  1000U * US_PER_TICK, 0U};
  wrong = qj_pilot_load(&pilot, QUADJAX_WORDS, sizeof(QUADJAX_WORDS), &interface);
  if ((wrong == 0) && (pilot.policy.period_ns % (1000U * US_PER_TICK) != 0U)) {
    wrong = "its time step is no whole number of ms";
  }
  if (wrong != 0) {
    DEBUG_PRINT("quadjax: policy rejected: %s\n", wrong);
  }
}

bool controllerOutOfTreeTest(void) { return wrong == 0; }

/* The firmware's world is forward-left-up, its gyro in deg/s, forward-left-up. */
static void read_vehicle(const sensorData_t *sensors, const state_t *state, uint32_t time_us,
                         qj_vehicle *vehicle) {
  const qj_vehicle found = {
      .time_us = time_us,
      .position = {state->position.x, -state->position.y, -state->position.z},
      .velocity = {state->velocity.x, -state->velocity.y, -state->velocity.z},
      .quaternion = {state->attitudeQuaternion.w, state->attitudeQuaternion.x,
                     -state->attitudeQuaternion.y, -state->attitudeQuaternion.z},
      .rates = {RAD_PER_DEG * sensors->gyro.x, -RAD_PER_DEG * sensors->gyro.y,
                -RAD_PER_DEG * sensors->gyro.z}};
  *vehicle = found;
  qj_euler_of(vehicle->quaternion, vehicle->euler);
}

static void stop(void) {
  qj_pilot_reset(&pilot);
  for (uint32_t i = 0U; i < 4U; ++i) {
    motors[i] = 0.0F;
  }
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint,
                         const sensorData_t *sensors, const state_t *state,
                         const stabilizerStep_t stabilizerStep) {
  if ((wrong != 0) || (setpoint->mode.z == modeDisable)) {
    stop();
  } else {
    const uint32_t now_us = US_PER_TICK * (uint32_t)stabilizerStep;
    qj_vehicle vehicle;
    read_vehicle(sensors, state, now_us, &vehicle);
    (void)qj_pilot_step(&pilot, now_us, &vehicle, motors);
  }
  control->controlMode = controlModeForce;
  for (uint32_t i = 0U; i < 4U; ++i) {
    control->normalizedForces[i] = motors[place_of_motor[i]];
  }
  target = (uint8_t)pilot.race.target;
  nan_steps = pilot.counters.nan_steps;
  clipped_steps = pilot.counters.clipped_steps;
}

LOG_GROUP_START(quadjax)
LOG_ADD(LOG_UINT8, target, &target)
LOG_ADD(LOG_UINT32, nanSteps, &nan_steps)
LOG_ADD(LOG_UINT32, clippedSteps, &clipped_steps)
LOG_GROUP_STOP(quadjax)
