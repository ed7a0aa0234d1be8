/* See qj_pilot.h. */
#include "qj_pilot.h"

#include <math.h>

#define LARGEST 1e6F         /* magnitude of a number of the state: beyond it counts as not finite */
#define STEP_TOLERANCE 0.03F /* of the calls in a step */
#define GIVEN_UP 2U          /* of lost */
#define RATE_TOLERANCE 0.01F /* of an estimator's sample rate */

static void set(float *to, const float *from, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    to[i] = from[i];
  }
}

/* The one place where numbers from outside are checked. */
static void take(float *to, const float *from, uint32_t count, uint32_t *is_nan) {
  for (uint32_t i = 0U; i < count; ++i) {
    const uint32_t is_wrong =
        ((qj_is_finite(from[i]) == 0U) || (fabsf(from[i]) > LARGEST)) ? 1U : 0U;
    to[i] = (is_wrong != 0U) ? 0.0F : from[i];
    *is_nan |= is_wrong;
  }
}

/* ---- start --------------------------------------------------------------------------------------- */

static uint32_t is_close(float rate, float other) {
  return (fabsf(rate - other) <= RATE_TOLERANCE * other) ? 1U : 0U;
}

/* Why a policy cannot fly with calls at a rate, or 0. */
static const char *unsuitable(const qj_policy *policy, qj_kernel kernel, float calls_per_s) {
  const float calls = calls_per_s * policy->step_s;
  const float whole = -floorf(0.5F - calls); /* a step is due half a call before its time */
  if (!(calls_per_s >= 1.0F) || !(calls_per_s <= 1e6F)) {
    return "the rate of the calls is not between 1 Hz and 1 MHz";
  }
  for (uint32_t i = 0U; i < policy->layers; ++i) {
    if ((policy->layer[i].padded_columns > QJ_MAX_WIDTH) ||
        (policy->layer[i].padded_rows > QJ_MAX_WIDTH)) {
      return "it is wider than QJ_MAX_WIDTH of qj_sizes.h";
    }
  }
  if ((qj_observes(policy, QJ_LAST_COMMAND) != 0U) &&
      !((whole >= 1.0F) && (fabsf(whole - calls) <= STEP_TOLERANCE * whole))) {
    return "no whole number of calls is a step of it, within 3%";
  }
  if (((policy->disturbance != 0) && !is_close(calls_per_s, policy->disturbance->sample_rate)) ||
      ((policy->battery != 0) && !is_close(calls_per_s, policy->battery->sample_rate))) {
    return "its estimator is for another rate than that of the calls";
  }
  return (qj_self_test(policy, kernel) != 0U) ? 0 : "its self-test fails";
}

const char *qj_pilot_start(qj_pilot *pilot, const qj_policy *policy, qj_kernel kernel,
                           float calls_per_s) {
  static const qj_pilot none = {0};
  const char *const wrong = unsuitable(policy, kernel, calls_per_s);
  *pilot = none;
  if (wrong == 0) {
    pilot->policy = policy;
    pilot->kernel = kernel;
    pilot->every_call = (qj_observes(policy, QJ_LAST_COMMAND) == 0U) ? 1U : 0U;
    pilot->call_us = (uint32_t)(1e6F / calls_per_s + 0.5F);
    pilot->state.highest_rpm = (policy->battery != 0) ? policy->battery->first : 0.0F;
    qj_pilot_reset(pilot);
  }
  return wrong;
}

void qj_pilot_reset(qj_pilot *pilot) {
  const qj_policy *const policy = pilot->policy;
  pilot->racing = 0U;
  pilot->lost = 0U;
  qj_race_start(&pilot->race);
  for (uint32_t i = 0U; (policy != 0) && (i < QJ_COMMANDS); ++i) { /* halfway between the limits */
    const float unit = 0.5F / (float)(UINT32_C(1) << policy->fraction_bits);
    pilot->state.last_command[i] = ((float)policy->low[i] + (float)policy->high[i]) * unit;
  }
}

/* ---- states -------------------------------------------------------------------------------------- */

/* Whether a time is after another, on a clock that wraps around. */
static uint32_t is_after(uint32_t time_us, uint32_t other_us) {
  const uint32_t apart = time_us - other_us;
  return ((apart != 0U) && (apart < (UINT32_C(1) << 31))) ? 1U : 0U;
}

static uint32_t is_fresh(uint32_t now_us, uint32_t time_us) {
  return (now_us - time_us + QJ_STALE_US <= 2U * QJ_STALE_US) ? 1U : 0U;
}

/* Whether a state may be used: its parts neither stale nor as far ahead, and newer than the last. */
static uint32_t is_usable(const qj_pilot *pilot, uint32_t now_us, const qj_vehicle *vehicle) {
  if ((vehicle == 0) || (is_fresh(now_us, vehicle->time_us) == 0U) ||
      (is_fresh(now_us, vehicle->position_us) == 0U)) {
    return 0U;
  }
  return ((pilot->racing == 0U) || (is_after(vehicle->time_us, pilot->state_us) != 0U)) ? 1U : 0U;
}

/* The estimators, with the commands, rpm, that were in effect before this state. After a gap they
 * continue with their last estimates: a filter would take the change over the gap for one of a call. */
static void estimate(qj_pilot *pilot, const qj_vehicle *vehicle, const float *commands,
                     uint32_t *is_nan) {
  const qj_policy *const policy = pilot->policy;
  const uint32_t since = vehicle->time_us - pilot->state_us;
  const uint32_t is_next =
      ((pilot->has_state != 0U) && (since <= pilot->call_us + pilot->call_us / 2U)) ? 1U : 0U;
  qj_measured measured;
  float command[QJ_COMMANDS];
  take(measured.rates, vehicle->rates, 3U, is_nan);
  take(measured.specific_force, vehicle->specific_force, 3U, is_nan);
  take(measured.body_velocity, vehicle->body_velocity, 3U, is_nan);
  take(command, commands, QJ_COMMANDS, is_nan);
  for (uint32_t i = 0U; i < 4U; ++i) {
    measured.rotor_rpm[i] = pilot->state.rotor_speed[i] * QJ_RPM_PER_RAD_S;
  }
  if (policy->disturbance != 0) {
    if (is_next == 0U) {
      qj_disturbance_start(policy->disturbance, &pilot->disturbance, &measured, pilot->estimate);
    }
    qj_disturbance_update(policy->disturbance, &pilot->disturbance, &measured, pilot->estimate);
    set(pilot->state.moment_ext, pilot->estimate, 3U);
    set(pilot->state.force_ext, pilot->estimate + 3, 3U);
  }
  if ((policy->battery != 0) && (is_next == 0U)) {
    qj_battery_start(&pilot->battery, measured.rotor_rpm);
  } else if (policy->battery != 0) {
    qj_battery_update(policy->battery, &pilot->battery, measured.rotor_rpm, command,
                      &pilot->state.highest_rpm);
  }
}

static void read_state(qj_pilot *pilot, const qj_vehicle *vehicle, const float *commands) {
  qj_state *const state = &pilot->state;
  uint32_t is_nan = 0U;
  uint32_t is_nan_of_estimators = 0U;
  take(state->position, vehicle->position, 3U, &is_nan);
  take(state->velocity, vehicle->velocity, 3U, &is_nan);
  take(state->quaternion, vehicle->quaternion, 4U, &is_nan);
  take(state->rates, vehicle->rates, 3U, &is_nan);
  take(state->rotor_speed, vehicle->rotor_speed, 4U, &is_nan);
  take(&state->thrust, &vehicle->thrust, 1U, &is_nan);
  if ((pilot->policy->disturbance != 0) || (pilot->policy->battery != 0)) {
    estimate(pilot, vehicle, commands, &is_nan_of_estimators);
  }
  pilot->is_nan = is_nan | is_nan_of_estimators;
  pilot->state_us = vehicle->time_us;
  pilot->has_state = 1U;
}

/* ---- calls --------------------------------------------------------------------------------------- */

/* One step of the policy. The gates see the position as it came: one that is not finite is none. */
static void decide(qj_pilot *pilot, const float position[3]) {
  float x[QJ_MAX_WIDTH];
  int32_t q[QJ_MAX_WIDTH];
  const qj_policy *const policy = pilot->policy;
  (void)qj_race_update(policy, &pilot->race, position);
  qj_observe(policy, &pilot->state, pilot->race.target, x);
  pilot->last = qj_quantize(policy, x, q);
  qj_act(policy, pilot->kernel, q, &pilot->noise, pilot->state.last_command);
  ++pilot->counters.steps;
  pilot->counters.nan_steps += pilot->is_nan;
  pilot->counters.outside_steps += (pilot->last.outside != 0U) ? 1U : 0U;
}

void qj_pilot_wait(qj_pilot *pilot, const qj_vehicle *vehicle) {
  qj_pilot_reset(pilot);
  if ((pilot->policy != 0) && (vehicle != 0)) {
    read_state(pilot, vehicle, vehicle->autopilot_command);
  }
}

static qj_pilot_status missing(qj_pilot *pilot, uint32_t now_us, float command[QJ_COMMANDS]) {
  pilot->lost_us = (pilot->lost == 0U) ? now_us : pilot->lost_us;
  pilot->lost = (pilot->lost == 0U) ? 1U : pilot->lost;
  ++pilot->counters.late_calls;
  if ((pilot->racing != 0U) && (pilot->lost != GIVEN_UP) &&
      (now_us - pilot->lost_us <= QJ_HOLD_US)) {
    set(command, pilot->state.last_command, QJ_COMMANDS);
    return QJ_HELD;
  }
  if (pilot->racing != 0U) { /* the motors get 0, until a step at the next state */
    set(pilot->state.last_command, command, QJ_COMMANDS);
    pilot->step_us = now_us - (uint32_t)(1e6F * pilot->policy->step_s);
  }
  return QJ_LOST;
}

qj_pilot_status qj_pilot_step(qj_pilot *pilot, uint32_t now_us, const qj_vehicle *vehicle,
                              float command[QJ_COMMANDS]) {
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    command[i] = 0.0F;
  }
  if (pilot->policy == 0) {
    return QJ_UNUSABLE;
  }
  if ((pilot->racing != 0U) && (pilot->lost != 0U) &&
      (now_us - pilot->lost_us > QJ_GIVE_UP_US)) {
    pilot->lost = GIVEN_UP;
  }
  if ((pilot->lost == GIVEN_UP) || (is_usable(pilot, now_us, vehicle) == 0U)) {
    return missing(pilot, now_us, command);
  }
  read_state(pilot, vehicle,
             (pilot->racing != 0U) ? pilot->state.last_command : vehicle->autopilot_command);
  const float half_call_us = 0.5F * (float)pilot->call_us;
  const float since_us = (float)(now_us - pilot->step_us);
  const uint32_t is_due = ((pilot->racing == 0U) || (pilot->every_call != 0U) ||
                           (since_us >= 1e6F * pilot->policy->step_s - half_call_us)) ? 1U : 0U;
  pilot->racing = 1U;
  pilot->lost = 0U;
  if (is_due != 0U) {
    pilot->step_us = now_us;
    decide(pilot, vehicle->position);
  }
  set(command, pilot->state.last_command, QJ_COMMANDS);
  return QJ_FLYING;
}
