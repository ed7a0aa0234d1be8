/* See qjp_pilot.h. */
#include "qjp_pilot.h"

static const char *unsuitable(const qjp_policy *policy, uint32_t has_rotor_speeds) {
  if (qjp_is_motor_policy(policy) == 0U) {
    return "its commands are no motor commands within 0 and 1";
  }
  if ((qjp_observes(policy, QJP_MOMENT_EXT) | qjp_observes(policy, QJP_FORCE_EXT)) != 0U) {
    return "it observes external disturbances, which are not estimated here";
  }
  if ((has_rotor_speeds == 0U) && (qjp_observes(policy, QJP_ROTOR_SPEED) != 0U)) {
    return "it observes rotor speeds, which are not measured here";
  }
  return 0;
}

const char *qjp_pilot_load(qjp_pilot *pilot, const int32_t *words, uint32_t bytes,
                           uint32_t has_rotor_speeds) {
  const qjp_counters zero = {0U, 0U, 0U, 0U};
  pilot->usable = 0U;
  pilot->counters = zero;
  const qjp_error error = qjp_load(&pilot->policy, words, bytes);
  if (error != QJP_OK) {
    return qjp_error_name(error);
  }
  const char *const wrong = unsuitable(&pilot->policy, has_rotor_speeds);
  if (wrong == 0) {
    pilot->usable = 1U;
    qjp_pilot_reset(pilot);
  }
  return wrong;
}

void qjp_pilot_reset(qjp_pilot *pilot) {
  const qjp_policy *const policy = &pilot->policy;
  pilot->racing = 0U;
  for (uint32_t i = 0U; (pilot->usable != 0U) && (i < QJP_COMMANDS); ++i) {
    const float unit = 0.5F / (float)(UINT32_C(1) << policy->fraction_bits);
    pilot->command[i] = ((float)policy->low[i] + (float)policy->high[i]) * unit;
  }
}

static void read_state(const qjp_pilot *pilot, const qjp_vehicle *vehicle, float *state) {
  const qjp_policy *const policy = &pilot->policy;
  float rotors[QJP_COMMANDS];
  for (uint32_t i = 0U; i < policy->state_size; ++i) {
    state[i] = 0.0F;
  }
  for (uint32_t i = 0U; i < QJP_COMMANDS; ++i) {
    rotors[i] = vehicle->rotor_speed[policy->places[i]];
  }
  qjp_set(policy, state, QJP_POSITION, vehicle->position);
  qjp_set(policy, state, QJP_VELOCITY, vehicle->velocity);
  qjp_set(policy, state, QJP_EULER, vehicle->euler);
  qjp_set(policy, state, QJP_QUATERNION, vehicle->quaternion);
  qjp_set(policy, state, QJP_RATES, vehicle->rates);
  qjp_set(policy, state, QJP_ROTOR_SPEED, rotors);
  qjp_set(policy, state, QJP_LAST_COMMAND, pilot->command);
}

static void count(qjp_counters *counters, qjp_status status) {
  ++counters->steps;
  counters->nan_steps += (status.nan != 0U) ? 1U : 0U;
  counters->clipped_steps += (status.clipped != 0U) ? 1U : 0U;
  counters->outside_steps += (status.outside != 0U) ? 1U : 0U;
}

void qjp_pilot_step(qjp_pilot *pilot, const qjp_vehicle *vehicle, float motors[QJP_COMMANDS]) {
  QJP_BUFFER float state[QJP_MAX_STATE];
  QJP_BUFFER int32_t q[QJP_MAX_WIDTH];
  int32_t integers[QJP_COMMANDS];
  const qjp_policy *const policy = &pilot->policy;
  for (uint32_t i = 0U; i < QJP_COMMANDS; ++i) {
    motors[i] = 0.0F;
  }
  if (pilot->usable == 0U) {
    return;
  }
  if (pilot->racing == 0U) {
    qjp_race_start(policy, &pilot->race, vehicle->position, 0U);
    pilot->racing = 1U;
  }
  read_state(pilot, vehicle, state);
  (void)qjp_race_update(policy, &pilot->race, vehicle->position);
  count(&pilot->counters, qjp_observe(policy, state, pilot->race.target, q));
  qjp_forward(policy, q, integers, 0);
  qjp_commands(policy, integers, pilot->command);
  for (uint32_t i = 0U; i < QJP_COMMANDS; ++i) {
    motors[policy->places[i]] = pilot->command[i];
  }
}
