/* The observation and the gates: see qj.h. qj_load has checked every number on which the comments about
 * overflow below depend. */
#include "qj_integers.h"

/* 2^32 / (2 pi): a yaw in Q24 times this is in turns of 2^56. */
#define TURNS_PER_UNIT INT64_C(683565276)
#define TURN_SHIFT 56
#define TWO_PI INT64_C(6746518852) /* Q30 */
/* Products of a quaternion are in Q58; elements of its matrix are held to +-2. */
#define QUATERNION_ONE (INT64_C(1) << 58)
#define MATRIX_SHIFT 28
#define MATRIX_LIMIT (INT64_C(1) << 31)

static const int32_t *gate_of(const qj_policy *policy, uint32_t target) {
  return policy->gate + ((target < policy->gates) ? target : 0U) * policy->gate_words;
}

/* Into the network's range, and whether it was outside. */
static inline int32_t hold(int64_t value, uint32_t *outside, uint32_t input) {
  const int64_t held = qj_clamp(value, -QJ_INPUT_ONE, QJ_INPUT_ONE);
  qj_flag(outside, input, (held != value) ? 1U : 0U);
  return (int32_t)held;
}

/* ---- the observation ---------------------------------------------------------------------------- */

/* A vector through the gate, to its right and down: coordinates of at most 2^31 times at most 2^30,
 * twice. */
static void see_vector(const int32_t *gate, const int64_t v[3], int32_t shift, uint32_t at,
                       uint32_t *outside, int32_t *q) {
  const int64_t cosine = gate[QJ_GATE_COSINE];
  const int64_t sine = gate[QJ_GATE_SINE];
  q[at] = hold(qj_round_shift(cosine * v[0] + sine * v[1], shift), outside, at);
  q[at + 1U] = hold(qj_round_shift(cosine * v[1] - sine * v[0], shift), outside, at + 1U);
  q[at + 2U] = hold(qj_round_shift(v[2] * QJ_INPUT_ONE, shift), outside, at + 2U);
}

/* An element of the rotation matrix: a sum of products in Q58, to Q30. */
static int64_t element(int64_t sum) {
  return qj_clamp(qj_round_shift(sum, MATRIX_SHIFT), -MATRIX_LIMIT, MATRIX_LIMIT);
}

/* The body's x and z axes in the gate's frame. */
static void see_rotation(const int32_t *gate, const int32_t *s, int32_t shift, uint32_t at,
                         uint32_t *outside, int32_t *q) {
  const int64_t w = s[0];
  const int64_t x = s[1];
  const int64_t y = s[2];
  const int64_t z = s[3];
  const int64_t front[3] = {element(QUATERNION_ONE - 2 * (y * y + z * z)),
                            element(2 * (x * y + w * z)), element(2 * (x * z - w * y))};
  const int64_t down[3] = {element(2 * (x * z + w * y)), element(2 * (y * z - w * x)),
                           element(QUATERNION_ONE - 2 * (x * x + y * y))};
  see_vector(gate, front, shift, at, outside, q);
  see_vector(gate, down, shift, at + 3U, outside, q);
}

/* The yaw relative to the gate, within half a turn by one multiplication and no loop. */
static int64_t relative_yaw(const int32_t *gate, int32_t yaw, int32_t exponent) {
  const int64_t apart = yaw * (INT64_C(1) << QJ_YAW_EXPONENT) - qj_long(gate + QJ_GATE_YAW);
  const int64_t turns = ((apart >> QJ_YAW_EXPONENT) * TURNS_PER_UNIT +
                         (INT64_C(1) << (TURN_SHIFT - 1))) >> TURN_SHIFT;
  const int64_t wrapped = apart - turns * TWO_PI;
  return (exponent > 0) ? qj_round_shift(wrapped, exponent) : wrapped * (INT64_C(1) << -exponent);
}

/* Inputs that are computed together, from numbers of the state that follow each other. */
static void see(const qj_policy *policy, const int32_t *part, const int32_t *s, const int32_t *gate,
                uint32_t *outside, int32_t *q) {
  const uint32_t at = (uint32_t)part[QJ_PART_INDEX];
  const uint32_t first = (uint32_t)policy->input[QJ_INPUT_WORDS * at + QJ_INPUT_SOURCE];
  const int32_t exponent = part[QJ_PART_EXPONENT];
  const int32_t shift = Q30 - policy->exponents[first] + exponent;
  int64_t v[3] = {s[first], s[first + 1U], s[first + 2U]};
  switch (part[QJ_PART_KIND]) {
    case QJ_SEE_POSITION:
      for (uint32_t i = 0U; i < 3U; ++i) {
        v[i] -= gate[QJ_GATE_POSITION + i];
      }
      see_vector(gate, v, shift, at, outside, q);
      break;
    case QJ_SEE_VELOCITY:
      see_vector(gate, v, shift, at, outside, q);
      break;
    case QJ_SEE_ATTITUDE:
      q[at] = s[first];
      q[at + 1U] = s[first + 1U];
      q[at + 2U] = hold(relative_yaw(gate, s[first + 2U], exponent), outside, at + 2U);
      break;
    default: /* QJ_SEE_ROTATION */
      see_rotation(gate, s + first, Q30 + exponent, at, outside, q);
      break;
  }
}

/* Inputs of one number each. */
static void see_numbers(const qj_policy *policy, const int32_t *part, const int32_t *s,
                        const int32_t *gate, uint32_t *outside, int32_t *q) {
  const int32_t kind = part[QJ_PART_KIND];
  const uint32_t first = (uint32_t)part[QJ_PART_INDEX];
  const uint32_t end = first + (uint32_t)part[QJ_PART_SIZE];
  const int32_t *input = policy->input + QJ_INPUT_WORDS * first;
  for (uint32_t at = first; at < end; ++at) {
    const uint32_t source = (uint32_t)input[QJ_INPUT_SOURCE];
    if (kind == QJ_SEE_SCALED) {
      const int64_t apart = (int64_t)s[source] - input[QJ_INPUT_MIDDLE];
      q[at] = hold(qj_round_shift(apart * input[QJ_INPUT_FACTOR], input[QJ_INPUT_SHIFT]), outside,
                   at);
    } else {
      q[at] = (kind == QJ_SEE_COPY) ? s[source] : gate[QJ_GATE_WORDS + source];
    }
    input += QJ_INPUT_WORDS;
  }
}

qj_status qj_observe(const qj_policy *policy, uint32_t target, const float *state, int32_t *q) {
  int32_t s[QJ_MAX_STATE];
  const int32_t *const gate = gate_of(policy, target);
  const int32_t *part = policy->part;
  qj_status status = qj_quantize_all(state, policy->exponents, policy->state_size, s);
  for (uint32_t number = 0U; number < policy->parts; ++number) {
    if (part[QJ_PART_KIND] < QJ_SEE_COPY) {
      see(policy, part, s, gate, &status.outside, q);
    } else {
      see_numbers(policy, part, s, gate, &status.outside, q);
    }
    part += QJ_PART_WORDS;
  }
  return status;
}

const int32_t *qj_find_field(const qj_policy *policy, int32_t code) {
  for (uint32_t i = 0U; i < policy->fields; ++i) {
    if (policy->field[QJ_FIELD_WORDS * i + QJ_FIELD_CODE] == code) {
      return policy->field + QJ_FIELD_WORDS * i;
    }
  }
  return 0;
}

uint32_t qj_observes(const qj_policy *policy, qj_field field) {
  const int32_t *const found = qj_find_field(policy, (int32_t)field);
  uint32_t observed = 0U;
  for (uint32_t i = 0U; (found != 0) && (i < policy->parts); ++i) {
    const int32_t *const part = policy->part + QJ_PART_WORDS * i;
    const int32_t first = found[QJ_FIELD_START];
    for (int32_t k = 0; (part[QJ_PART_KIND] != QJ_SEE_GATE) && (k < part[QJ_PART_SIZE]); ++k) {
      const int32_t *const input = policy->input + QJ_INPUT_WORDS * (part[QJ_PART_INDEX] + k);
      const uint32_t zero =
          ((part[QJ_PART_KIND] == QJ_SEE_SCALED) && (input[QJ_INPUT_FACTOR] == 0)) ? 1U : 0U;
      observed |=
          qj_within(input[QJ_INPUT_SOURCE], first, first + found[QJ_FIELD_SIZE] - 1) & ~zero;
    }
  }
  return observed & 1U;
}

/* ---- the gates ---------------------------------------------------------------------------------- */

static uint32_t quantize_position(const qj_policy *policy, const float position[3], int32_t p[3]) {
  const qj_status status =
      qj_quantize_all(position, policy->exponents + policy->position, 3U, p);
  return status.clipped | status.nan;
}

void qj_race_start(const qj_policy *policy, qj_race *race, const float position[3],
                   uint32_t target) {
  race->placed = (quantize_position(policy, position, race->previous) == 0U) ? 1U : 0U;
  race->target = (target < policy->gates) ? target : 0U;
  race->passed = 0U;
  race->missed = 0U;
}

static int64_t magnitude(int64_t value) { return (value < 0) ? -value : value; }

/* A vector along one of the gate's axes: three products of at most 2^61. */
static int64_t on_axis(const int32_t *gate, uint32_t number, const int64_t v[3]) {
  const int32_t *const axis = gate + QJ_GATE_AXES + 3U * number;
  return axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2];
}

/* Whether a point relative to the gate's center is in the opening, along the world's axes or its
 * own. */
static uint32_t is_inside(const qj_policy *policy, const int32_t *gate, const int64_t v[3]) {
  const int64_t half_width = gate[QJ_GATE_HALF_WIDTH];
  const int64_t half_height = gate[QJ_GATE_HALF_HEIGHT];
  if (policy->world_box != 0U) {
    return ((magnitude(v[0]) < half_width) && (magnitude(v[1]) < half_width) &&
            (magnitude(v[2]) < half_height)) ? 1U : 0U;
  }
  const int64_t right = magnitude(qj_round_shift(on_axis(gate, 1U, v), Q30));
  const int64_t down = magnitude(qj_round_shift(on_axis(gate, 2U, v), Q30));
  if ((right > half_width) || (down > half_height)) {
    return 0U;
  }
  if ((gate[QJ_GATE_ROUND] == 0) || (down > half_width)) {
    return (gate[QJ_GATE_ROUND] == 0) ? 1U : 0U;
  }
  return (right * right + down * down <= half_width * half_width) ? 1U : 0U;
}

/* A gate is crossed when the position goes from behind its plane to in front of it. */
static qj_event crossing(const qj_policy *policy, const qj_race *race, const int32_t now[3]) {
  const int32_t *const gate = gate_of(policy, race->target);
  int64_t before[3];
  int64_t after[3];
  for (uint32_t i = 0U; i < 3U; ++i) {
    before[i] = (int64_t)race->previous[i] - gate[QJ_GATE_POSITION + i];
    after[i] = (int64_t)now[i] - gate[QJ_GATE_POSITION + i];
  }
  if ((on_axis(gate, 0U, before) >= 0) || (on_axis(gate, 0U, after) < 0)) {
    return QJ_NO_EVENT;
  }
  return (is_inside(policy, gate, after) != 0U) ? QJ_GATE_PASSED : QJ_GATE_MISSED;
}

qj_event qj_race_update(const qj_policy *policy, qj_race *race, const float position[3]) {
  int32_t now[3];
  race->target = (race->target < policy->gates) ? race->target : 0U;
  if (quantize_position(policy, position, now) != 0U) {
    return QJ_NO_EVENT;
  }
  const qj_event event = (race->placed != 0U) ? crossing(policy, race, now) : QJ_NO_EVENT;
  race->placed = 1U;
  if (event == QJ_GATE_PASSED) {
    race->target = (race->target + 1U < policy->gates) ? race->target + 1U : 0U;
    ++race->passed;
  } else if (event == QJ_GATE_MISSED) {
    ++race->missed;
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    race->previous[i] = now[i];
  }
  return event;
}
