/* See quadjax_module.h. The only file that knows Paparazzi: what it reads from the state interface,
 * what it tells the ground. Everything that computes is in the files next to it. */
#include "modules/quadjax/quadjax_module.h"

#include <sys/auxv.h>

#include "autopilot.h"
#include "boards/bebop/actuators.h"
#include "mcu_periph/sys_time.h"
#include "modules/core/abi.h"
#include "modules/datalink/telemetry.h"
#include "modules/quadjax/qj_pilot.h"
#include "modules/quadjax/quadjax_policy.h"
#include "state.h"
#if defined(PREFLIGHT_CHECKS) && PREFLIGHT_CHECKS
#include "modules/checks/preflight_checks.h"
#endif

#ifndef HWCAP_NEON
#define HWCAP_NEON (1UL << 12)
#endif
/* The board's motors in the order front-left, front-right, rear-right, rear-left. */
#ifndef QUADJAX_MOTORS
#define QUADJAX_MOTORS {0, 1, 2, 3}
#endif

uint8_t quadjax_module_enable = 1;

static const uint8_t motor[4] = QUADJAX_MOTORS;
static qj_pilot pilot;
static const char *wrong = "not loaded";
static bool flying;
static float commands[4];

/* ---- what the autopilot knows ------------------------------------------------------------------ */

static void read_vehicle(qj_vehicle *vehicle) {
  const struct NedCoor_f *const position = stateGetPositionNed_f();
  const struct NedCoor_f *const velocity = stateGetSpeedNed_f();
  const struct FloatEulers *const euler = stateGetNedToBodyEulers_f();
  const struct FloatQuat *const quaternion = stateGetNedToBodyQuat_f();
  const struct FloatRates *const rates = stateGetBodyRates_f();
  const struct Int32Vect3 *const acceleration = stateGetAccelBody_i();
  const struct FloatVect3 world_velocity = {velocity->x, velocity->y, velocity->z};
  struct FloatVect3 body_velocity;
  float_rmat_vmult(&body_velocity, stateGetNedToBodyRMat_f(), &world_velocity);
  const qj_vehicle found = {
      .time_us = get_sys_time_usec(),
      .position = {position->x, position->y, position->z},
      .velocity = {velocity->x, velocity->y, velocity->z},
      .euler = {euler->phi, euler->theta, euler->psi},
      .quaternion = {quaternion->qi, quaternion->qx, quaternion->qy, quaternion->qz},
      .rates = {rates->p, rates->q, rates->r},
      .gyro = {rates->p, rates->q, rates->r},
      /* Of the accelerometer less its bias; specific thrust is what it feels along body -z. */
      .specific_force = {ACCEL_FLOAT_OF_BFP(acceleration->x), ACCEL_FLOAT_OF_BFP(acceleration->y),
                         ACCEL_FLOAT_OF_BFP(acceleration->z)},
      .thrust = {-ACCEL_FLOAT_OF_BFP(acceleration->z)},
      .body_velocity = {body_velocity.x, body_velocity.y, body_velocity.z},
  };
  *vehicle = found;
  for (uint32_t i = 0U; i < 4U; ++i) {
    vehicle->rotor_rpm[i] = (float)actuators_bebop.rpm_obs[motor[i]];
    vehicle->others_command[i] = (float)actuators_bebop.rpm_ref[motor[i]];
  }
}

/* ---- the ground --------------------------------------------------------------------------------- */

#if defined(PERIODIC_TELEMETRY) && PERIODIC_TELEMETRY
static void send_status(struct transport_tx *trans, struct link_device *dev) {
  const qj_counters *const counters = &pilot.counters;
  float values[] = {(wrong != 0) ? 1.0f : 0.0f,         flying ? 1.0f : 0.0f,
                    (float)pilot.policy.kernel,         (float)pilot.race.target,
                    (float)pilot.race.passed,           (float)pilot.race.missed,
                    (float)counters->steps,             (float)counters->clipped_steps,
                    (float)counters->nan_steps,         (float)counters->outside_steps,
                    (float)pilot.last.clipped,          (float)pilot.last.nan,
                    (float)pilot.last.outside,          (float)counters->estimator_calls,
                    pilot.highest_rpm[0]};
  pprz_msg_send_PAYLOAD_FLOAT(trans, dev, AC_ID, (uint8_t)(sizeof(values) / sizeof(values[0])),
                              values);
}
#endif

#if defined(PREFLIGHT_CHECKS) && PREFLIGHT_CHECKS
static struct preflight_check_t policy_check;

static void check_policy(struct preflight_result_t *result) {
  if (wrong != 0) {
    preflight_error(result, "quadjax: %s", wrong);
  } else {
    preflight_success(result, "quadjax: policy loaded, self-tests passed");
  }
}
#endif

/* ---- the module --------------------------------------------------------------------------------- */

void quadjax_module_init(void) {
  const qj_interface interface = {
      QJ_GIVES(QJ_EULER) | QJ_GIVES(QJ_QUATERNION) | QJ_GIVES(QJ_ROTOR_RPM) | QJ_GIVES(QJ_THRUST) |
          QJ_GIVES_SENSORS,
      QJ_GIVES(QJ_RPM) | QJ_GIVES(QJ_RATES_THRUST), 1000000000U / QUADJAX_FREQUENCY};
  flying = false;
  wrong = qj_pilot_load(&pilot, QUADJAX_WORDS, sizeof(QUADJAX_WORDS), &interface);
#if QJ_HAS_NEON
  /* Whether the processor has it; the self-tests again with the kernel that flies. */
  pilot.policy.kernel = (getauxval(AT_HWCAP) & HWCAP_NEON) ? QJ_NEON : QJ_SCALAR;
  if ((wrong == 0) && (qj_self_test(&pilot.policy) != 0U)) {
    wrong = qj_error_name(QJ_BAD_SELF_TEST);
  }
  qj_pilot_reset(&pilot);
#endif
#if defined(PREFLIGHT_CHECKS) && PREFLIGHT_CHECKS
  preflight_check_register(&policy_check, check_policy);
#endif
#if defined(PERIODIC_TELEMETRY) && PERIODIC_TELEMETRY
  register_periodic_telemetry(DefaultPeriodic, PPRZ_MSG_ID_PAYLOAD_FLOAT, send_status);
#endif
}

const char *quadjax_module_wrong(void) { return wrong; }

void quadjax_module_periodic(void) {
  qj_vehicle vehicle;
  const bool wanted = (autopilot_get_mode() == QUADJAX_MODE) && (quadjax_module_enable != 0U);
  if (wrong != 0) {
    /* Refuse to arm: whoever arms is disarmed within one period. */
    flying = false;
    autopilot_set_motors_on(false);
    return;
  }
  read_vehicle(&vehicle);
  if (wanted) {
    flying = (qj_pilot_step(&pilot, vehicle.time_us, &vehicle, commands) != QJ_LOST);
  } else {
    qj_pilot_wait(&pilot, &vehicle);
    flying = false;
  }
}

bool quadjax_module_command(float command[4]) {
  for (uint32_t i = 0U; flying && (i < 4U); ++i) {
    command[(pilot.policy.kind == QJ_RPM) ? motor[i] : i] = commands[i];
  }
  return flying;
}
