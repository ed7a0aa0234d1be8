/* See qj_pilot.h. */
#include "qj_pilot.h"

#include "qj_integers.h"

#define NS_PER_US 1000U
enum { RATE_PARTS = 100 }; /* an estimator's rate may be off by 1% */
enum { STEP_PARTS = 100, STEP_ERROR = 3 }; /* calls in a step may be off by 3% */
/* Numbers that an autopilot always gives, or that the pilot has itself. */
#define ALWAYS_GIVEN                                                                     \
  (QJ_GIVES(QJ_POSITION) | QJ_GIVES(QJ_VELOCITY) | QJ_GIVES(QJ_RATES) |                  \
   QJ_GIVES(QJ_LAST_COMMAND))

static const float zeros[QJ_COMMANDS] = {0.0F, 0.0F, 0.0F, 0.0F};

static void copy(float *to, const float *from, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    to[i] = from[i];
  }
}

/* Whether a and b differ by at most one part in ``parts``. */
static uint32_t is_close(uint64_t a, uint64_t b, uint64_t parts) {
  return ((parts * a <= (parts + 1U) * b) && (parts * a >= (parts - 1U) * b)) ? 1U : 0U;
}

/* Whether the nearest whole number of calls is a period. */
static uint32_t is_whole(uint32_t period_ns, uint32_t call_ns) {
  if (call_ns == 0U) {
    return 0U;
  }
  const float calls = (float)period_ns / (float)call_ns + 0.5F; /* not in integers: no library */
  if (calls >= 4294967040.0F) {
    return 0U;
  }
  const uint64_t time = (uint64_t)(uint32_t)calls * call_ns;
  const uint64_t apart = (time > period_ns) ? time - period_ns : period_ns - time;
  return ((time != 0U) && (STEP_PARTS * apart <= STEP_ERROR * time)) ? 1U : 0U;
}

/* Why an autopilot cannot fly a policy, or 0. */
static const char *unsuitable(qj_pilot *pilot, const qj_interface *interface) {
  const qj_policy *const policy = &pilot->policy;
  const uint32_t gives = interface->gives;
  if ((interface->kinds & QJ_GIVES(policy->kind)) == 0U) {
    return "its commands are not of a kind that is taken here";
  }
  const int32_t one = INT32_C(1) << policy->fraction_bits;
  for (uint32_t i = 0U; (policy->kind == QJ_MOTOR) && (i < QJ_COMMANDS); ++i) {
    if ((qj_within(policy->low[i], 0, one) & qj_within(policy->high[i], 0, one)) == 0U) {
      return "its motor commands are not within 0 and 1";
    }
  }
  const uint32_t can = ((gives & QJ_GIVES_SENSORS) != 0U) && ((gives & QJ_GIVES(QJ_ROTOR_RPM)) != 0U);
  const uint32_t rate_of_estimator =
      (policy->estimator != 0) &&
      (is_close((uint32_t)policy->estimator[QJ_ESTIMATOR_PERIOD_NS], interface->call_ns,
                RATE_PARTS) != 0U);
  pilot->own_estimator = can & rate_of_estimator;
  const uint32_t missing =
      (qj_observes(policy, QJ_MOMENT_EXT) & ~(gives >> (uint32_t)QJ_MOMENT_EXT)) |
      (qj_observes(policy, QJ_FORCE_EXT) & ~(gives >> (uint32_t)QJ_FORCE_EXT));
  if ((missing != 0U) && (pilot->own_estimator == 0U)) {
    return ((can != 0U) && (policy->estimator != 0))
               ? "its estimator is for another rate than that of the calls"
               : "it observes external disturbances, which are not estimated here";
  }
  if (qj_observes(policy, QJ_HIGHEST_RPM) != 0U) {
    if ((policy->battery == 0) || ((gives & QJ_GIVES(QJ_ROTOR_RPM)) == 0U)) {
      return "it observes the highest rpm, which is not estimated here";
    }
    if (is_close((uint32_t)policy->battery[QJ_BATTERY_PERIOD_NS], interface->call_ns,
                 RATE_PARTS) == 0U) {
      return "its estimator of the highest rpm is for another rate than that of the calls";
    }
  }
  const uint32_t always = ALWAYS_GIVEN | QJ_GIVES(QJ_MOMENT_EXT) | QJ_GIVES(QJ_FORCE_EXT) |
                          QJ_GIVES(QJ_HIGHEST_RPM);
  for (uint32_t code = QJ_POSITION; code <= QJ_HIGHEST_RPM; ++code) {
    if ((((gives | always) & QJ_GIVES(code)) == 0U) && (qj_observes(policy, (qj_field)code) != 0U)) {
      return ((code == QJ_ROTOR_SPEED) || (code == QJ_ROTOR_RPM))
                 ? "it observes rotor speeds, which are not measured here"
                 : "it observes a number that is not measured here";
    }
  }
  if ((pilot->every_call == 0U) && (is_whole(policy->period_ns, interface->call_ns) == 0U)) {
    return "no whole number of calls is a step of it, within 3%";
  }
  return 0;
}

const char *qj_pilot_load(qj_pilot *pilot, const int32_t *words, uint32_t bytes,
                          const qj_interface *interface) {
  const qj_counters none = {0U, 0U, 0U, 0U, 0U, 0U};
  pilot->usable = 0U;
  pilot->gives = interface->gives;
  pilot->counters = none;
  pilot->highest_rpm[0] = 0.0F;
  pilot->estimator.started = 0U;
  pilot->battery.started = 0U;
  qj_pilot_reset(pilot);
  const qj_error error = qj_load(&pilot->policy, words, bytes);
  if (error != QJ_OK) {
    return qj_error_name(error);
  }
  if (interface->call_ns == 0U) {
    return "call_ns is 0";
  }
  pilot->every_call = (qj_observes(&pilot->policy, QJ_LAST_COMMAND) == 0U) ? 1U : 0U;
  const uint32_t half_call_ns = interface->call_ns / 2U;
  pilot->due_us = (pilot->policy.period_ns > half_call_ns)
                      ? (pilot->policy.period_ns - half_call_ns) / NS_PER_US
                      : 0U;
  const char *const wrong = unsuitable(pilot, interface);
  if (wrong == 0) {
    pilot->usable = 1U;
    qj_pilot_reset(pilot);
  }
  return wrong;
}

void qj_pilot_reset(qj_pilot *pilot) {
  const qj_policy *const policy = &pilot->policy;
  pilot->racing = 0U;
  pilot->lost = 0U;
  pilot->race.target = 0U;
  pilot->race.passed = 0U;
  pilot->race.missed = 0U;
  for (uint32_t i = 0U; (pilot->usable != 0U) && (i < QJ_COMMANDS); ++i) {
    const float unit = 0.5F / (float)(UINT32_C(1) << policy->fraction_bits);
    pilot->command[i] = ((float)policy->low[i] + (float)policy->high[i]) * unit;
  }
}

static uint32_t is_given(const qj_pilot *pilot, int32_t code) {
  return (((pilot->gives | ALWAYS_GIVEN) & QJ_GIVES(code)) != 0U) ? 1U : 0U;
}

/* What the estimators give, at every call. */
static void estimate(qj_pilot *pilot, const qj_vehicle *vehicle, const float *commands) {
  const qj_policy *const policy = &pilot->policy;
  uint32_t wrong = 0U;
  copy(pilot->moment, (is_given(pilot, QJ_MOMENT_EXT) != 0U) ? vehicle->moment_ext : zeros, 3U);
  copy(pilot->force, (is_given(pilot, QJ_FORCE_EXT) != 0U) ? vehicle->force_ext : zeros, 3U);
  if (pilot->own_estimator != 0U) {
    float measured[13];
    copy(measured, vehicle->gyro, 3U);
    copy(measured + 3, vehicle->specific_force, 3U);
    copy(measured + 6, vehicle->rotor_rpm, 4U);
    copy(measured + 10, vehicle->body_velocity, 3U);
    const qj_status status =
        qj_estimator_update(policy, &pilot->estimator, measured, pilot->moment, pilot->force);
    wrong |= status.clipped | status.nan;
  }
  if ((policy->battery != 0) && (is_given(pilot, QJ_ROTOR_RPM) != 0U)) {
    float sample[8];
    copy(sample, vehicle->rotor_rpm, 4U);
    copy(sample + 4, commands, 4U);
    const qj_status status =
        qj_battery_update(policy, &pilot->battery, sample, pilot->highest_rpm);
    wrong |= status.clipped | status.nan;
  }
  pilot->counters.estimator_calls += (wrong != 0U) ? 1U : 0U;
}

/* A field of the state; zeros where the autopilot does not give it. */
static const float *numbers_of(const qj_pilot *pilot, const qj_vehicle *vehicle, int32_t code) {
  const uint32_t here = ((code == QJ_MOMENT_EXT) || (code == QJ_FORCE_EXT) ||
                         (code == QJ_HIGHEST_RPM)) ? 1U : 0U;
  if ((here | is_given(pilot, code)) == 0U) {
    return zeros;
  }
  switch (code) {
    case QJ_POSITION:
      return vehicle->position;
    case QJ_VELOCITY:
      return vehicle->velocity;
    case QJ_EULER:
      return vehicle->euler;
    case QJ_QUATERNION:
      return vehicle->quaternion;
    case QJ_RATES:
      return vehicle->rates;
    case QJ_ROTOR_SPEED:
      return vehicle->rotor_speed;
    case QJ_MOMENT_EXT:
      return pilot->moment;
    case QJ_FORCE_EXT:
      return pilot->force;
    case QJ_LAST_COMMAND:
      return pilot->command;
    case QJ_ROTOR_RPM:
      return vehicle->rotor_rpm;
    case QJ_THRUST:
      return vehicle->thrust;
    default: /* QJ_HIGHEST_RPM */
      return pilot->highest_rpm;
  }
}

/* One step of the policy. */
static void decide(qj_pilot *pilot, const qj_vehicle *vehicle) {
  float state[QJ_MAX_STATE];
  int32_t q[QJ_MAX_WIDTH];
  const qj_policy *const policy = &pilot->policy;
  qj_counters *const counters = &pilot->counters;
  int32_t integers[QJ_COMMANDS];
  for (uint32_t i = 0U; i < policy->fields; ++i) {
    const int32_t *const field = policy->field + QJ_FIELD_WORDS * i;
    copy(state + field[QJ_FIELD_START], numbers_of(pilot, vehicle, field[QJ_FIELD_CODE]),
         (uint32_t)field[QJ_FIELD_SIZE]);
  }
  (void)qj_race_update(policy, &pilot->race, vehicle->position);
  pilot->last = qj_observe(policy, pilot->race.target, state, q);
#ifdef QJ_SAMPLED
  qj_sample(policy, q, &pilot->noise, integers);
#else
  qj_forward(policy, q, integers, 0);
#endif
  qj_commands(policy, integers, pilot->command);
  ++counters->steps;
  counters->nan_steps += (pilot->last.nan != 0U) ? 1U : 0U;
  counters->clipped_steps += (pilot->last.clipped != 0U) ? 1U : 0U;
  counters->outside_steps += (pilot->last.outside != 0U) ? 1U : 0U;
}

void qj_pilot_wait(qj_pilot *pilot, const qj_vehicle *vehicle) {
  if (pilot->usable != 0U) {
    qj_pilot_reset(pilot);
    estimate(pilot, vehicle, vehicle->others_command);
  }
}

/* Whether a time is after another, on a clock that wraps around. */
static uint32_t is_after(uint32_t time_us, uint32_t other_us) {
  const uint32_t apart = time_us - other_us;
  return ((apart != 0U) && (apart < (UINT32_C(1) << 31))) ? 1U : 0U;
}

/* Whether a state may be used: neither stale, nor as far ahead, nor older than the one before. */
static uint32_t is_new(const qj_pilot *pilot, uint32_t now_us, const qj_vehicle *vehicle) {
  if ((vehicle == 0) || (now_us - vehicle->time_us + QJ_STALE_US > 2U * QJ_STALE_US)) {
    return 0U;
  }
  return ((pilot->racing == 0U) || (is_after(vehicle->time_us, pilot->state_us) != 0U)) ? 1U : 0U;
}

static qj_pilot_status missing(qj_pilot *pilot, uint32_t now_us, float command[QJ_COMMANDS]) {
  pilot->lost_us = (pilot->lost == 0U) ? now_us : pilot->lost_us;
  pilot->lost = 1U;
  ++pilot->counters.late_calls;
  if ((pilot->racing != 0U) && (now_us - pilot->lost_us <= QJ_HOLD_US)) {
    copy(command, pilot->command, QJ_COMMANDS);
    return QJ_HELD;
  }
  if (pilot->racing != 0U) { /* the motors get 0, until a step at the next state */
    copy(pilot->command, command, QJ_COMMANDS);
    pilot->step_us = now_us - pilot->due_us;
  }
  return QJ_LOST;
}

qj_pilot_status qj_pilot_step(qj_pilot *pilot, uint32_t now_us, const qj_vehicle *vehicle,
                              float command[QJ_COMMANDS]) {
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    command[i] = 0.0F;
  }
  if (pilot->usable == 0U) {
    return QJ_UNUSABLE;
  }
  if (is_new(pilot, now_us, vehicle) == 0U) {
    return missing(pilot, now_us, command);
  }
  const uint32_t since = now_us - pilot->step_us;
  const uint32_t due = ((pilot->racing == 0U) || (pilot->every_call != 0U) ||
                        (since >= pilot->due_us)) ? 1U : 0U;
  estimate(pilot, vehicle, (pilot->racing != 0U) ? pilot->command : vehicle->others_command);
  if (pilot->racing == 0U) {
    qj_race_start(&pilot->policy, &pilot->race, vehicle->position, 0U);
  }
  pilot->racing = 1U;
  pilot->lost = 0U;
  pilot->state_us = vehicle->time_us;
  if (due != 0U) {
    pilot->step_us = now_us;
    decide(pilot, vehicle);
  }
  copy(command, pilot->command, QJ_COMMANDS);
  return QJ_FLYING;
}
