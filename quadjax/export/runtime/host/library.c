/* A policy as a library of this machine, for quadjax verify and quadjax sil. Each function takes
 * many rows at once. Not for flight. */
#include "qj_pilot.h"
#include "quadjax_policy.h"

static const qj_policy *const policy = &QUADJAX_POLICY;

uint32_t library_pilot_size(void);
const char *library_start(qj_pilot *pilot, float calls_per_s);
void library_counts(const qj_pilot *pilot, uint32_t counts[8]);
void library_estimate(const qj_pilot *pilot, float estimate[7]);
void library_quantize(const float *x, int32_t *q, uint32_t count);
void library_forward(const int32_t *q, int32_t *out, uint32_t count);
void library_act(const int32_t *q, float *out, uint32_t count, uint32_t counter);
void library_observe(const qj_state *states, const uint32_t *targets, float *out, uint32_t count);
void library_race(const float *positions, uint32_t *out, uint32_t count);
void library_disturbances(const qj_measured *measured, float *out, uint32_t count);
void library_battery(const float *samples, float *out, uint32_t count);

uint32_t library_pilot_size(void) { return sizeof(qj_pilot); }

const char *library_start(qj_pilot *pilot, float calls_per_s) {
  return qj_pilot_start(pilot, policy, QJ_DEFAULT_KERNEL, calls_per_s);
}

void library_counts(const qj_pilot *pilot, uint32_t counts[8]) {
  const uint32_t found[8] = {pilot->counters.steps,      pilot->counters.outside_steps,
                             pilot->counters.late_calls, pilot->counters.nan_calls,
                             pilot->race.target,         pilot->race.passed,
                             pilot->race.missed,         pilot->outside};
  for (uint32_t i = 0U; i < 8U; ++i) {
    counts[i] = found[i];
  }
}

/* Moment, force, highest rpm. */
void library_estimate(const qj_pilot *pilot, float estimate[7]) {
  for (uint32_t i = 0U; i < 6U; ++i) {
    estimate[i] = pilot->estimate[i];
  }
  estimate[6] = pilot->state.highest_rpm;
}

void library_quantize(const float *x, int32_t *q, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    (void)qj_quantize(policy, x + i * policy->inputs, q + i * policy->inputs);
  }
}

/* Row: commands, trace. */
void library_forward(const int32_t *q, int32_t *out, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i, out += QJ_COMMANDS + 1) {
    uint32_t trace;
    qj_forward(policy, QJ_DEFAULT_KERNEL, q + i * policy->inputs, out, &trace);
    out[QJ_COMMANDS] = (int32_t)trace;
  }
}

/* counter: of the noise; 0 for the mean action. */
void library_act(const int32_t *q, float *out, uint32_t count, uint32_t counter) {
  uint32_t *const noise = (counter != 0U) ? &counter : 0;
  for (uint32_t i = 0U; i < count; ++i, out += QJ_COMMANDS) {
    qj_act(policy, QJ_DEFAULT_KERNEL, q + i * policy->inputs, noise, out);
  }
}

void library_observe(const qj_state *states, const uint32_t *targets, float *out, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    qj_observe(policy, states + i, targets[i], out + i * policy->inputs);
  }
}

/* Row: the event and the target after it, along one path; of targets[0] at first. */
void library_race(const float *positions, uint32_t *out, uint32_t count) {
  qj_race race;
  qj_race_start(&race);
  race.target = out[1];
  for (uint32_t i = 0U; i < count; ++i, out += 2) {
    out[0] = (uint32_t)qj_race_update(policy, &race, positions + 3U * i);
    out[1] = race.target;
  }
}

void library_disturbances(const qj_measured *measured, float *out, uint32_t count) {
  qj_disturbance memory;
  float estimate[6] = {0.0F, 0.0F, 0.0F, 0.0F, 0.0F, 0.0F};
  qj_disturbance_start(policy->disturbance, &memory, measured, estimate);
  for (uint32_t i = 0U; i < count; ++i, out += 6) {
    qj_disturbance_update(policy->disturbance, &memory, measured + i, estimate);
    for (uint32_t k = 0U; k < 6U; ++k) {
      out[k] = estimate[k];
    }
  }
}

/* Of samples: rotor speeds and commands, rpm. */
void library_battery(const float *samples, float *out, uint32_t count) {
  qj_battery memory;
  float highest = policy->battery->first;
  qj_battery_start(&memory, samples);
  out[0] = highest;
  for (uint32_t i = 1U; i < count; ++i) {
    qj_battery_update(policy->battery, &memory, samples + 8U * i, samples + 8U * i + 4U, &highest);
    out[i] = highest;
  }
}
