/* The gates: see qj.h. The rule is that of quadjax/race/openings.py. */
#include <math.h>

#include "qj.h"

void qj_race_start(qj_race *race) {
  race->placed = 0U;
  race->target = 0U;
  race->passed = 0U;
  race->missed = 0U;
}

/* A position in the opening's frame: through it, along its width, along its height. */
static void to_opening(const qj_gate *gate, const float position[3], float out[3]) {
  float apart[3];
  for (uint32_t i = 0U; i < 3U; ++i) {
    apart[i] = position[i] - gate->position[i];
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    const float *const axis = gate->axes[i];
    out[i] = axis[0] * apart[0] + axis[1] * apart[1] + axis[2] * apart[2];
  }
}

static uint32_t is_inside(const qj_gate *gate, float right, float down) {
  if (gate->is_round != 0U) {
    return (sqrtf(right * right + down * down) <= gate->half_width) ? 1U : 0U;
  }
  return ((fabsf(right) <= gate->half_width) && (fabsf(down) <= gate->half_height)) ? 1U : 0U;
}

/* A gate is crossed when the position goes from behind its plane to in front of it. */
static qj_event crossing(const qj_policy *policy, const qj_gate *gate, const float from[3],
                         const float to[3]) {
  float before[3];
  float after[3];
  to_opening(gate, from, before);
  to_opening(gate, to, after);
  if (!((before[0] < 0.0F) && (after[0] >= 0.0F))) {
    return QJ_NO_EVENT;
  }
  uint32_t passed;
  if (policy->gate_test == QJ_WORLD_BOX) {
    passed = ((fabsf(to[0] - gate->position[0]) < gate->half_width) &&
              (fabsf(to[1] - gate->position[1]) < gate->half_width) &&
              (fabsf(to[2] - gate->position[2]) < gate->half_height)) ? 1U : 0U;
  } else if (policy->gate_test == QJ_INTERPOLATED) {
    const float fraction = -before[0] / (after[0] - before[0]);
    passed = is_inside(gate, before[1] + fraction * (after[1] - before[1]),
                       before[2] + fraction * (after[2] - before[2]));
  } else {
    passed = is_inside(gate, after[1], after[2]);
  }
  return (passed != 0U) ? QJ_GATE_PASSED : QJ_GATE_MISSED;
}

qj_event qj_race_update(const qj_policy *policy, qj_race *race, const float position[3]) {
  qj_event event = QJ_NO_EVENT;
  for (uint32_t i = 0U; i < 3U; ++i) {
    if ((qj_is_finite(position[i]) == 0U) || (fabsf(position[i]) > QJ_LARGEST)) {
      return QJ_NO_EVENT;
    }
  }
  race->target = (race->target < policy->gates) ? race->target : 0U;
  if (race->placed != 0U) {
    event = crossing(policy, policy->gate + race->target, race->previous, position);
  }
  if (event == QJ_GATE_PASSED) {
    race->target = (race->target + 1U < policy->gates) ? race->target + 1U : 0U;
    ++race->passed;
  } else if (event == QJ_GATE_MISSED) {
    ++race->missed;
  }
  race->placed = 1U;
  for (uint32_t i = 0U; i < 3U; ++i) {
    race->previous[i] = position[i];
  }
  return event;
}
