/* Batches for the checks of the loader: many states in one call. Not for flight. */
#include "qjp.h"

uint32_t harness_load(const int32_t *words, uint32_t bytes);
void harness_forward(const int32_t *q, int32_t *out, uint32_t count);
void harness_observe(const float *states, const uint32_t *targets, int32_t *out, uint32_t count);
void harness_events(const float *positions, uint32_t target, uint32_t *out, uint32_t count);

void harness_step(qjp_race *race, const float *state, float *command);

qjp_policy policy;

uint32_t harness_load(const int32_t *words, uint32_t bytes) {
  return (uint32_t)qjp_load(&policy, words, bytes);
}

/* A step as firmware takes it; the position is first in the state. */
void harness_step(qjp_race *race, const float *state, float *command) {
  QJP_BUFFER int32_t q[QJP_MAX_WIDTH];
  int32_t integers[QJP_COMMANDS];
  (void)qjp_race_update(&policy, race, state);
  (void)qjp_observe(&policy, state, race->target, q);
  qjp_forward(&policy, q, integers, 0);
  qjp_commands(&policy, integers, command);
}

/* Row: commands, trace. */
void harness_forward(const int32_t *q, int32_t *out, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    uint32_t trace;
    qjp_forward(&policy, q, out, &trace);
    out[QJP_COMMANDS] = (int32_t)trace;
    q += policy.inputs;
    out += QJP_COMMANDS + 1;
  }
}

/* Row: inputs, clipped, NaN, outside. */
void harness_observe(const float *states, const uint32_t *targets, int32_t *out, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    const qjp_status status = qjp_observe(&policy, states, targets[i], out);
    out[policy.inputs] = (int32_t)status.clipped;
    out[policy.inputs + 1U] = (int32_t)status.nan;
    out[policy.inputs + 2U] = (int32_t)status.outside;
    states += policy.state_size;
    out += policy.inputs + 3U;
  }
}

/* Row: the event and the target after it, along one trajectory. */
void harness_events(const float *positions, uint32_t target, uint32_t *out, uint32_t count) {
  qjp_race race;
  qjp_race_start(&policy, &race, positions, target);
  for (uint32_t i = 0U; i < count; ++i) {
    out[0] = (uint32_t)qjp_race_update(&policy, &race, positions);
    out[1] = race.target;
    positions += 3;
    out += 2;
  }
}
