/* See qj_pilot.h. */
#include "qj_pilot.h"

#include <math.h>

#define STEP_TOLERANCE 0.03F /* of the calls in a step */
#define RATE_TOLERANCE 0.01F /* of an estimator's sample rate */
#define MOST_FILLED 20U      /* calls of a gap through which the estimators go on */

static void set(float *to, const float *from, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    to[i] = from[i];
  }
}

/* ---- start ----------------------------------------------------------------------------------- */

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
  pilot->link = QJ_HAS_STATE;
  pilot->outside = 0U;
  qj_race_start(&pilot->race);
  for (uint32_t i = 0U; (policy != 0) && (i < QJ_COMMANDS); ++i) { /* halfway between the limits */
    const float unit = 0.5F / (float)(UINT32_C(1) << policy->fraction_bits);
    pilot->state.last_command[i] = ((float)policy->low[i] + (float)policy->high[i]) * unit;
  }
}

/* ---- states ---------------------------------------------------------------------------------- */

/* Whether a time is after another, on a clock that wraps around. */
static uint32_t is_after(uint32_t time_us, uint32_t other_us) {
  const uint32_t apart = time_us - other_us;
  return ((apart != 0U) && (apart < (UINT32_C(1) << 31))) ? 1U : 0U;
}

static uint32_t is_fresh(uint32_t now_us, uint32_t time_us) {
  return (now_us - time_us + QJ_STALE_US <= 2U * QJ_STALE_US) ? 1U : 0U;
}

/* The one place where numbers from outside are checked. */
static uint32_t are_finite(const float *x, uint32_t count) {
  uint32_t finite = 1U;
  for (uint32_t i = 0U; i < count; ++i) {
    finite &= qj_is_finite(x[i]) & ((fabsf(x[i]) <= QJ_LARGEST) ? 1U : 0U);
  }
  return finite;
}

static uint32_t is_finite(const qj_vehicle *v) {
  return are_finite(v->position, 3U) & are_finite(v->velocity, 3U) & are_finite(v->quaternion, 4U) &
         are_finite(v->rates, 3U) & are_finite(v->rotor_speed, 4U) & are_finite(&v->thrust, 1U) &
         are_finite(v->specific_force, 3U) & are_finite(v->body_velocity, 3U) &
         are_finite(v->autopilot_command, QJ_COMMANDS);
}

/* Whether a state may be used: finite, no part stale or as far ahead, and newer than the last. */
static uint32_t is_usable(qj_pilot *pilot, uint32_t now_us, const qj_vehicle *vehicle) {
  if ((vehicle == 0) || (is_fresh(now_us, vehicle->time_us) == 0U) ||
      (is_fresh(now_us, vehicle->position_us) == 0U)) {
    return 0U;
  }
  if (is_finite(vehicle) == 0U) {
    ++pilot->counters.nan_calls;
    return 0U;
  }
  return ((pilot->racing == 0U) || (is_after(vehicle->time_us, pilot->state_us) != 0U)) ? 1U : 0U;
}

/* A part of the way from one sample to the next. */
static qj_measured interpolated(const qj_measured *from, const qj_measured *to, float part) {
  qj_measured middle;
  for (uint32_t i = 0U; i < 3U; ++i) {
    middle.rates[i] = from->rates[i] + part * (to->rates[i] - from->rates[i]);
    middle.specific_force[i] =
        from->specific_force[i] + part * (to->specific_force[i] - from->specific_force[i]);
    middle.body_velocity[i] =
        from->body_velocity[i] + part * (to->body_velocity[i] - from->body_velocity[i]);
  }
  for (uint32_t i = 0U; i < 4U; ++i) {
    middle.rotor_rpm[i] = from->rotor_rpm[i] + part * (to->rotor_rpm[i] - from->rotor_rpm[i]);
  }
  return middle;
}

/* Start the estimators at a sample. They continue with their last estimates. */
static void start_estimators(qj_pilot *pilot, const qj_measured *measured) {
  if (pilot->policy->disturbance != 0) {
    qj_disturbance_start(pilot->policy->disturbance, &pilot->disturbance, measured,
                         pilot->estimate);
  }
  qj_battery_start(&pilot->battery, measured->rotor_rpm);
}

/* The estimators, with the commands, rpm, that were in effect before this state. A filter would
 * take the change over a gap for that of one call: its calls are filled in, along a line. */
static void estimate(qj_pilot *pilot, const qj_measured *measured, uint32_t calls,
                     const float *commands) {
  const qj_policy *const policy = pilot->policy;
  for (uint32_t call = 1U; call <= calls; ++call) {
    const qj_measured now =
        interpolated(&pilot->measured, measured, (float)call / (float)calls);
    if (policy->disturbance != 0) {
      qj_disturbance_update(policy->disturbance, &pilot->disturbance, &now, pilot->estimate);
    }
    if (policy->battery != 0) {
      qj_battery_update(policy->battery, &pilot->battery, now.rotor_rpm, commands,
                        &pilot->state.highest_rpm);
    }
  }
  set(pilot->state.moment_ext, pilot->estimate, 3U);
  set(pilot->state.force_ext, pilot->estimate + 3, 3U);
}

static void read_state(qj_pilot *pilot, const qj_vehicle *vehicle, const float *commands) {
  qj_state *const state = &pilot->state;
  const uint32_t since = vehicle->time_us - pilot->state_us;
  const uint32_t calls = (since + pilot->call_us / 2U) / pilot->call_us;
  qj_measured measured;
  set(state->position, vehicle->position, 3U);
  set(state->velocity, vehicle->velocity, 3U);
  set(state->quaternion, vehicle->quaternion, 4U);
  set(state->rates, vehicle->rates, 3U);
  set(state->rotor_speed, vehicle->rotor_speed, 4U);
  state->thrust = vehicle->thrust;
  set(measured.rates, vehicle->rates, 3U);
  set(measured.specific_force, vehicle->specific_force, 3U);
  set(measured.body_velocity, vehicle->body_velocity, 3U);
  for (uint32_t i = 0U; i < 4U; ++i) {
    measured.rotor_rpm[i] = vehicle->rotor_speed[i] * QJ_RPM_PER_RAD_S;
  }
  if ((pilot->has_state != 0U) && (calls <= MOST_FILLED)) {
    estimate(pilot, &measured, (calls > 0U) ? calls : 1U, commands);
  } else {
    start_estimators(pilot, &measured);
  }
  pilot->measured = measured;
  pilot->state_us = vehicle->time_us;
  pilot->has_state = 1U;
}

/* ---- calls ----------------------------------------------------------------------------------- */

/* One step of the policy. */
static void decide(qj_pilot *pilot) {
  float x[QJ_MAX_WIDTH];
  int32_t q[QJ_MAX_WIDTH];
  const qj_policy *const policy = pilot->policy;
  (void)qj_race_update(policy, &pilot->race, pilot->state.position);
  qj_observe(policy, &pilot->state, pilot->race.target, x);
  const qj_status status = qj_quantize(policy, x, q);
  qj_act(policy, pilot->kernel, q, &pilot->noise, pilot->state.last_command);
  ++pilot->counters.steps;
  pilot->counters.outside_steps += (status.outside != 0U) ? 1U : 0U;
  pilot->outside |= status.outside;
}

void qj_pilot_standby(qj_pilot *pilot, const qj_vehicle *vehicle) {
  qj_pilot_reset(pilot);
  if ((pilot->policy != 0) && (vehicle != 0) && (is_finite(vehicle) != 0U)) {
    read_state(pilot, vehicle, vehicle->autopilot_command);
  }
}

/* Whether a race has been without a state for too long, also where nobody called meanwhile. */
static uint32_t is_given_up(const qj_pilot *pilot, uint32_t now_us) {
  if (pilot->racing == 0U) {
    return 0U;
  }
  const uint32_t since_state =
      (is_after(now_us, pilot->state_us) != 0U) ? now_us - pilot->state_us : 0U;
  const uint32_t since_lost = (pilot->link == QJ_MISSES_STATE) ? now_us - pilot->lost_us : 0U;
  return ((pilot->link == QJ_GAVE_UP) || (since_state > QJ_GIVE_UP_US) ||
          (since_lost > QJ_GIVE_UP_US)) ? 1U : 0U;
}

static qj_pilot_status missing(qj_pilot *pilot, uint32_t now_us, float command[QJ_COMMANDS]) {
  ++pilot->counters.late_calls;
  if (pilot->link == QJ_HAS_STATE) {
    pilot->link = QJ_MISSES_STATE;
    pilot->lost_us = now_us;
  }
  if ((pilot->racing != 0U) && (pilot->link == QJ_MISSES_STATE) &&
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

qj_pilot_status qj_pilot_call(qj_pilot *pilot, uint32_t now_us, const qj_vehicle *vehicle,
                              float command[QJ_COMMANDS]) {
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    command[i] = 0.0F;
  }
  if (pilot->policy == 0) {
    return QJ_UNUSABLE;
  }
  if (is_given_up(pilot, now_us) != 0U) {
    pilot->link = QJ_GAVE_UP;
  }
  if ((pilot->link == QJ_GAVE_UP) || (is_usable(pilot, now_us, vehicle) == 0U)) {
    return missing(pilot, now_us, command);
  }
  read_state(pilot, vehicle,
             (pilot->racing != 0U) ? pilot->state.last_command : vehicle->autopilot_command);
  const float half_call_us = 0.5F * (float)pilot->call_us;
  const float since_us = (float)(now_us - pilot->step_us);
  const uint32_t is_due = ((pilot->racing == 0U) || (pilot->every_call != 0U) ||
                           (since_us >= 1e6F * pilot->policy->step_s - half_call_us)) ? 1U : 0U;
  pilot->racing = 1U;
  pilot->link = QJ_HAS_STATE;
  if (is_due != 0U) {
    pilot->step_us = now_us;
    decide(pilot);
  }
  set(command, pilot->state.last_command, QJ_COMMANDS);
  return QJ_FLYING;
}
