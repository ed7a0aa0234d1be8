/*
 * A quadjax policy as the out-of-tree controller of a Crazyflie. NOT TESTED ON HARDWARE: compiled
 * against stand-ins of the firmware's headers. The policy is qjp_data.h; this file is the same for
 * every policy.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#include "FreeRTOS.h"
#include "app.h"
#include "controller.h"
#include "debug.h"
#include "log.h"
#include "qjp_data.h"
#include "qjp_pilot.h"
#include "task.h"

#define RAD_PER_DEG 0.017453292519943295F
#define NS_PER_TICK 1000000U /* of the stabilizer, 1 kHz */

/* Places of M1 .. M4: front-right, rear-right, rear-left, front-left. */
static const uint8_t place_of_motor[4] = {QJP_FRONT_RIGHT, QJP_REAR_RIGHT, QJP_REAR_LEFT,
                                          QJP_FRONT_LEFT};

static qjp_pilot pilot;
static const char *wrong = "not loaded";
static uint32_t ticks; /* of a step of the policy */
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
  wrong = qjp_pilot_load(&pilot, qjp_data, sizeof(qjp_data), 0U);
  if ((wrong == 0) && (pilot.policy.period_ns % NS_PER_TICK != 0U)) {
    wrong = "its time step is no whole number of ms";
    pilot.usable = 0U;
  }
  ticks = (pilot.usable != 0U) ? pilot.policy.period_ns / NS_PER_TICK : 1U;
  if (wrong != 0) {
    DEBUG_PRINT("quadjax: policy rejected: %s\n", wrong);
  }
}

bool controllerOutOfTreeTest(void) { return wrong == 0; }

/* The firmware's world is forward-left-up, its gyro in deg/s, forward-left-up. */
static void read_vehicle(const sensorData_t *sensors, const state_t *state, qjp_vehicle *vehicle) {
  const float w = state->attitudeQuaternion.w;
  const float x = state->attitudeQuaternion.x;
  const float y = -state->attitudeQuaternion.y;
  const float z = -state->attitudeQuaternion.z;
  const float sine = 2.0F * (w * y - z * x);
  const qjp_vehicle found = {
      {state->position.x, -state->position.y, -state->position.z},
      {state->velocity.x, -state->velocity.y, -state->velocity.z},
      {atan2f(2.0F * (w * x + y * z), 1.0F - 2.0F * (x * x + y * y)),
       asinf((sine > 1.0F) ? 1.0F : ((sine < -1.0F) ? -1.0F : sine)),
       atan2f(2.0F * (w * z + x * y), 1.0F - 2.0F * (y * y + z * z))},
      {w, x, y, z},
      {RAD_PER_DEG * sensors->gyro.x, -RAD_PER_DEG * sensors->gyro.y,
       -RAD_PER_DEG * sensors->gyro.z},
      {0.0F, 0.0F, 0.0F, 0.0F}};
  *vehicle = found;
}

static void stop(void) {
  qjp_pilot_reset(&pilot);
  for (uint32_t i = 0U; i < 4U; ++i) {
    motors[i] = 0.0F;
  }
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint,
                         const sensorData_t *sensors, const state_t *state,
                         const stabilizerStep_t stabilizerStep) {
  if ((wrong != 0) || (setpoint->mode.z == modeDisable)) {
    stop();
  } else if (stabilizerStep % ticks == 0U) {
    qjp_vehicle vehicle;
    read_vehicle(sensors, state, &vehicle);
    qjp_pilot_step(&pilot, &vehicle, motors);
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
