/* See quadjax_module.h. The only file that knows Paparazzi: what it reads from the state interface,
 * what it commands, what it tells the ground. The pilot is in the files next to it. */
#include "modules/quadjax/quadjax_module.h"

#include <sys/auxv.h>

#include "autopilot.h"
#include "boards/bebop/actuators.h"
#include "filters/low_pass_filter.h"
#include "mcu_periph/sys_time.h"
#include "modules/core/abi.h"
#include "modules/datalink/telemetry.h"
#include "modules/gps/gps.h"
#include "modules/quadjax/qj_pilot.h"
#include "modules/quadjax/quadjax_policy.h"
#include "state.h"
#if QUADJAX_COMMANDS_RATES
#include "firmwares/rotorcraft/stabilization.h"
#include "firmwares/rotorcraft/stabilization/stabilization_indi_simple.h"
#endif
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
/* Time of the position, on the clock of get_sys_time_usec(): that of the last message of motion
 * capture. */
#ifndef QUADJAX_POSITION_US
#define QUADJAX_POSITION_US \
  (gps.last_msg_time * 1000000U + usec_of_cpu_ticks(gps.last_msg_ticks))
#endif
/* Autopilot units of thrust for 1 m/s^2 more of specific force; cut-off of the filters, Hz. */
#ifndef QUADJAX_THRUST_GAIN
#define QUADJAX_THRUST_GAIN 500.0F
#endif
#ifndef QUADJAX_CUTOFF
#define QUADJAX_CUTOFF 8.0F
#endif

uint8_t quadjax_module_enable = 1;

static const uint8_t motor[4] = QUADJAX_MOTORS;
static qj_pilot pilot;
static const char *wrong = "not loaded";
static bool flying;
static float commands[4];
static Butterworth2LowPass felt_thrust; /* of the accelerometer along body -z, m/s^2 */
#if QUADJAX_COMMANDS_RATES
static Butterworth2LowPass given_thrust; /* of the thrust command, autopilot units */
#endif

/* ---- what the autopilot knows ---------------------------------------------------------------- */

static void read_vehicle(qj_vehicle *vehicle) {
  const struct NedCoor_f *const position = stateGetPositionNed_f();
  const struct NedCoor_f *const velocity = stateGetSpeedNed_f();
  const struct FloatQuat *const quaternion = stateGetNedToBodyQuat_f();
  const struct FloatRates *const rates = stateGetBodyRates_f();
  const struct Int32Vect3 *const acceleration = stateGetAccelBody_i();
  const struct FloatVect3 world_velocity = {velocity->x, velocity->y, velocity->z};
  struct FloatVect3 body_velocity;
  float_rmat_vmult(&body_velocity, stateGetNedToBodyRMat_f(), &world_velocity);
  const qj_vehicle found = {
      .time_us = get_sys_time_usec(),
      .position_us = QUADJAX_POSITION_US,
      .position = {position->x, position->y, position->z},
      .velocity = {velocity->x, velocity->y, velocity->z},
      .quaternion = {quaternion->qi, quaternion->qx, quaternion->qy, quaternion->qz},
      .rates = {rates->p, rates->q, rates->r},
      .thrust = update_butterworth_2_low_pass(&felt_thrust, -ACCEL_FLOAT_OF_BFP(acceleration->z)),
      /* Of the accelerometer less its bias. */
      .specific_force = {ACCEL_FLOAT_OF_BFP(acceleration->x), ACCEL_FLOAT_OF_BFP(acceleration->y),
                         ACCEL_FLOAT_OF_BFP(acceleration->z)},
      .body_velocity = {body_velocity.x, body_velocity.y, body_velocity.z},
  };
  *vehicle = found;
  for (uint32_t i = 0U; i < 4U; ++i) {
    vehicle->rotor_speed[i] = (float)actuators_bebop.rpm_obs[motor[i]] / QJ_RPM_PER_RAD_S;
    vehicle->autopilot_command[i] = (float)actuators_bebop.rpm_ref[motor[i]];
  }
}

/* ---- the ground ------------------------------------------------------------------------------ */

#if defined(PERIODIC_TELEMETRY) && PERIODIC_TELEMETRY
static void send_status(struct transport_tx *trans, struct link_device *dev) {
  const qj_counters *const counters = &pilot.counters;
  float values[] = {(wrong != 0) ? 1.0f : 0.0f,       flying ? 1.0f : 0.0f,
                    (float)pilot.kernel,              (float)pilot.race.target,
                    (float)pilot.race.passed,         (float)pilot.race.missed,
                    (float)counters->steps,           (float)counters->outside_steps,
                    (float)counters->late_calls,      (float)counters->nan_calls,
                    (float)pilot.outside,             pilot.state.highest_rpm};
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
    preflight_success(result, "quadjax: self-tests passed");
  }
}
#endif

/* ---- the module ------------------------------------------------------------------------------ */

void quadjax_module_init(void) {
  qj_kernel kernel = QJ_DEFAULT_KERNEL;
#if QJ_HAS_NEON
  kernel = (getauxval(AT_HWCAP) & HWCAP_NEON) ? QJ_NEON : QJ_SCALAR;
#endif
  const float tau = 1.0F / (6.2831853F * QUADJAX_CUTOFF);
  init_butterworth_2_low_pass(&felt_thrust, tau, 1.0F / QUADJAX_FREQUENCY, 9.81F);
#if QUADJAX_COMMANDS_RATES
  init_butterworth_2_low_pass(&given_thrust, tau, 1.0F / QUADJAX_FREQUENCY, 0.0F);
#endif
  flying = false;
  wrong = qj_pilot_start(&pilot, &QUADJAX_POLICY, kernel, QUADJAX_FREQUENCY);
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
#if QUADJAX_COMMANDS_RATES
  (void)update_butterworth_2_low_pass(&given_thrust, (float)stabilization_cmd[COMMAND_THRUST]);
#endif
  if (wanted) {
    flying = (qj_pilot_call(&pilot, vehicle.time_us, &vehicle, commands) != QJ_LOST);
  } else {
    qj_pilot_standby(&pilot, &vehicle);
    flying = false;
  }
}

#if QUADJAX_COMMANDS_RATES
bool quadjax_module_inner_loop(bool in_flight) {
  if (!flying) {
    return false;
  }
  /* What is missing of the commanded specific force is added to the filtered thrust command. */
  const float more = QUADJAX_THRUST_GAIN * (commands[3] - felt_thrust.o[0]);
  const float thrust = given_thrust.o[0] + more;
  const struct FloatRates rates = {commands[0], commands[1], commands[2]};
  stabilization_cmd[COMMAND_THRUST] =
      (int32_t)((thrust < 0.0F) ? 0.0F : ((thrust > MAX_PPRZ) ? MAX_PPRZ : thrust));
  stabilization_indi_rate_run(rates, in_flight);
  return true;
}
#else
bool quadjax_module_rpm(uint16_t rpm[4]) {
  for (uint32_t i = 0U; flying && (i < 4U); ++i) {
    rpm[motor[i]] = (uint16_t)commands[i];
  }
  return flying;
}
#endif
