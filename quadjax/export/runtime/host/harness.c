/* Batches for the verification: many rows in one call. Not for flight. */
#include "qj_pilot.h"

static const qj_interface interface = {INTERFACE_GIVES, INTERFACE_KINDS, INTERFACE_CALL_NS};

uint32_t harness_size(void);
uint32_t harness_load(qj_pilot *pilot, const int32_t *words, uint32_t bytes);
void harness_forward(const qj_pilot *pilot, const int32_t *q, int32_t *out, uint32_t count);
#ifdef QJ_SAMPLED
void harness_sample(const qj_pilot *pilot, const int32_t *q, uint32_t counter, int32_t *out,
                    uint32_t count);
#endif
void harness_observe(qj_pilot *pilot, const float *states, const uint32_t *targets, int32_t *out,
                     uint32_t count);
void harness_events(qj_pilot *pilot, const float *positions, uint32_t target, uint32_t *out,
                    uint32_t count);
void harness_estimate(qj_pilot *pilot, const float *measured, float *out, uint32_t count);
void harness_battery(qj_pilot *pilot, const float *samples, float *out, uint32_t count);

uint32_t harness_size(void) { return sizeof(qj_pilot); }

/* An error of qj_load, 100 for a pilot that refuses the policy, or the mismatches of the scalar kernel. */
uint32_t harness_load(qj_pilot *pilot, const int32_t *words, uint32_t bytes) {
  const char *const wrong = qj_pilot_load(pilot, words, bytes, &interface);
  const qj_error error = qj_load(&pilot->policy, words, bytes);
  pilot->policy.kernel = QJ_SCALAR;
  if (error != QJ_OK) {
    return (uint32_t)error;
  }
  return (wrong != 0) ? 100U : qj_self_test(&pilot->policy);
}

/* Row: commands, trace. */
void harness_forward(const qj_pilot *pilot, const int32_t *q, int32_t *out, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    uint32_t trace;
    qj_forward(&pilot->policy, q, out, &trace);
    out[QJ_COMMANDS] = (int32_t)trace;
    q += pilot->policy.inputs;
    out += QJ_COMMANDS + 1;
  }
}

#ifdef QJ_SAMPLED
/* Row: sampled commands, from a counter of the generator on. */
void harness_sample(const qj_pilot *pilot, const int32_t *q, uint32_t counter, int32_t *out,
                    uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    qj_sample(&pilot->policy, q, &counter, out);
    q += pilot->policy.inputs;
    out += QJ_COMMANDS;
  }
}
#endif

/* Row: inputs, clipped, NaN, outside. The states are those of one flight. */
void harness_observe(qj_pilot *pilot, const float *states, const uint32_t *targets, int32_t *out,
                     uint32_t count) {
  const qj_policy *const policy = &pilot->policy;
  qj_race_start(policy, &pilot->race, states, 0U);
  for (uint32_t i = 0U; i < count; ++i) {
    pilot->race.target = targets[i];
    const qj_status status = qj_observe(policy, pilot->race.target, states, out);
    out[policy->inputs] = (int32_t)status.clipped;
    out[policy->inputs + 1U] = (int32_t)status.nan;
    out[policy->inputs + 2U] = (int32_t)status.outside;
    states += policy->state_size;
    out += policy->inputs + 3U;
  }
}

/* Row: the event and the target after it, along one trajectory. */
void harness_events(qj_pilot *pilot, const float *positions, uint32_t target, uint32_t *out,
                    uint32_t count) {
  qj_race_start(&pilot->policy, &pilot->race, positions, target);
  for (uint32_t i = 0U; i < count; ++i) {
    out[0] = (uint32_t)qj_race_update(&pilot->policy, &pilot->race, positions);
    out[1] = pilot->race.target;
    positions += 3;
    out += 2;
  }
}

void harness_estimate(qj_pilot *pilot, const float *measured, float *out, uint32_t count) {
  pilot->estimator.started = 0U;
  for (uint32_t i = 0U; i < count; ++i) {
    (void)qj_estimator_update(&pilot->policy, &pilot->estimator, measured, out, out + 3);
    measured += 13;
    out += 6;
  }
}

void harness_battery(qj_pilot *pilot, const float *samples, float *out, uint32_t count) {
  pilot->battery.started = 0U;
  for (uint32_t i = 0U; i < count; ++i) {
    (void)qj_battery_update(&pilot->policy, &pilot->battery, samples, out);
    samples += 8;
    ++out;
  }
}
