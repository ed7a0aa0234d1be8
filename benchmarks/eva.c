/* What Frama-C analyzes: a pilot that is called with any state, any time and any memory of the race
 * and the estimators; and the network with any integers. See eva.py. */
#include "__fc_builtin.h"
#include "qj_pilot.h"
#include "quadjax_policy.h"

static float any_float(void) {
  union {
    float value;
    unsigned bits;
  } pun;
  pun.bits = Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU);
  return pun.value;
}
static float memory(void) { return Frama_C_float_interval(-1e9F, 1e9F); }
static uint32_t any_unsigned(void) { return Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU); }
static int32_t any_integer(void) { return Frama_C_interval(-2147483647 - 1, 2147483647); }

static qj_pilot pilot;

static void remember_anything(void) {
  pilot.policy = &QUADJAX_POLICY;
  pilot.kernel = QJ_SCALAR;
  pilot.every_call = any_unsigned();
  pilot.call_us = Frama_C_unsigned_int_interval(1U, 1000000U);
  pilot.racing = any_unsigned();
  pilot.step_us = any_unsigned();
  pilot.state_us = any_unsigned();
  pilot.has_state = any_unsigned();
  pilot.link = Frama_C_interval(0, 2);
  pilot.lost_us = any_unsigned();
  pilot.noise = any_unsigned();
  pilot.race.placed = any_unsigned();
  pilot.race.target = any_unsigned();
  pilot.race.passed = any_unsigned();
  pilot.race.missed = any_unsigned();
  pilot.state.highest_rpm = memory();
  for (uint32_t i = 0U; i < 3U; ++i) { pilot.race.previous[i] = memory(); }
  for (uint32_t i = 0U; i < 6U; ++i) {
    pilot.estimate[i] = memory();
    pilot.disturbance.first[i] = memory();
    pilot.disturbance.second[i] = memory();
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    pilot.measured.rates[i] = memory();
    pilot.measured.specific_force[i] = memory();
    pilot.measured.body_velocity[i] = memory();
  }
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    pilot.measured.rotor_rpm[i] = memory();
    pilot.state.last_command[i] = memory();
    pilot.battery.speed[i] = memory();
    pilot.battery.expected[i] = memory();
    pilot.battery.limited[i] = memory();
  }
}

void eva_main(void);
void eva_main(void) {
  qj_vehicle vehicle;
  float command[QJ_COMMANDS];
  float *const numbers = (float *)&vehicle;
  remember_anything();
  for (uint32_t i = 2U; i < sizeof(vehicle) / 4U; ++i) { numbers[i] = any_float(); }
  vehicle.time_us = any_unsigned();
  vehicle.position_us = any_unsigned();
  if (Frama_C_interval(0, 1) != 0) { qj_pilot_standby(&pilot, &vehicle); }
  (void)qj_pilot_call(&pilot, any_unsigned(), &vehicle, command);
  int32_t q[QJ_MAX_WIDTH];
  int32_t out[QJ_COMMANDS];
  for (uint32_t i = 0U; i < pilot.policy->inputs; ++i) { q[i] = any_integer(); }
  qj_forward(pilot.policy, QJ_SCALAR, q, out, 0);
  for (int i = 0; i < QJ_COMMANDS; ++i) {
    /*@ assert limits: pilot.policy->low[i] <= out[i] <= pilot.policy->high[i]; */
  }
}
