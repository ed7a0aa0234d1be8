/* A stand-in for the Crazyflie's firmware around the glue. */
#include <stdbool.h>

#include "firmware.h"

#define M2T(ms) (ms)
#define DEBUG_PRINT(...) print(__VA_ARGS__)
#define LOG_GROUP_START(name) static const void *const logged[] = {
#define LOG_ADD(type, name, address) address,
#define LOG_GROUP_STOP(name) 0};

typedef struct {
  uint32_t timestamp;
  float x, y, z;
} vec3_t;
typedef struct {
  uint32_t timestamp;
  float x, y, z, w;
} quaternion_t;
typedef struct {
  float x, y, z;
} Axis3f;
typedef struct {
  Axis3f acc;
  Axis3f gyro;
} sensorData_t;
typedef struct {
  quaternion_t attitudeQuaternion;
  vec3_t position;
  vec3_t velocity;
} state_t;
typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;
typedef struct {
  struct {
    stab_mode_t x, y, z;
  } mode;
} setpoint_t;
typedef enum { controlModeLegacy = 0, controlModeForceTorque = 1, controlModeForce = 2 } control_mode_t;
typedef struct {
  float normalizedForces[4];
  control_mode_t controlMode;
} control_t;
typedef uint32_t stabilizerStep_t;

void appMain(void);
void controllerOutOfTreeInit(void);
bool controllerOutOfTreeTest(void);
void controllerOutOfTree(control_t *control, const setpoint_t *setpoint,
                         const sensorData_t *sensors, const state_t *state,
                         const stabilizerStep_t stabilizerStep);
static void vTaskDelay(uint32_t ticks) { (void)ticks; }
static void print(const char *format, ...) { (void)format; }

#include "controller_quadjax.c"

const char *firmware_start(void) {
  controllerOutOfTreeInit();
  return wrong;
}

/* Its world and body are forward-left-up, its gyro is in deg/s. */
uint32_t firmware_call(uint32_t now_us, const qj_vehicle *vehicle, uint32_t flies,
                       float command[QJ_COMMANDS]) {
  static sensorData_t sensors;
  static state_t state;
  static uint32_t step;
  const setpoint_t setpoint = {{modeAbs, modeAbs, (flies != 0U) ? modeAbs : modeDisable}};
  control_t control = {{-1.0F, -1.0F, -1.0F, -1.0F}, controlModeLegacy};
  (void)now_us;
  (void)logged;
  if (vehicle != 0) {
    const float *const p = vehicle->position;
    const float *const v = vehicle->velocity;
    const float *const q = vehicle->quaternion;
    const float *const w = vehicle->rates;
    const sensorData_t measured = {
        {0.0F, 0.0F, 1.0F}, {w[0] / RAD_PER_DEG, -w[1] / RAD_PER_DEG, -w[2] / RAD_PER_DEG}};
    const state_t estimated = {{0U, q[1], -q[2], -q[3], q[0]},
                               {0U, p[0], -p[1], -p[2]},
                               {0U, v[0], -v[1], -v[2]}};
    sensors = measured;
    state = estimated;
  }
  controllerOutOfTree(&control, &setpoint, &sensors, &state, ++step);
  for (uint32_t i = 0U; i < 4U; ++i) {
    command[place_of_motor[i]] =
        (control.controlMode == controlModeForce) ? control.normalizedForces[i] : 0.0F;
  }
  return controllerOutOfTreeTest() ? 1U : 0U;
}

qj_pilot *firmware_pilot(void) { return &pilot; }
