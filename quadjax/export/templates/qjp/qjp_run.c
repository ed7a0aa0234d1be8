{% import "helpers.c" as c %}
/* The network and the observation of a loaded policy: see qjp.h. qjp_load has checked every number
 * on which the comments about overflow below depend. */
#include "qjp_layout.h"

${c.round_shift()}
/* ---- inputs ---------------------------------------------------------------------------------- */

{% include "quantize_one.c" %}

/* ---- the network ------------------------------------------------------------------------------- */

enum { ROWS_PER_BLOCK = QJP_ROWS_PER_BLOCK };
#define KERNEL static
{% include "scalar_kernel.c" %}

{% include "digest.c" %}

${c.relu_upper_word(32)}
static void block_sums(const qjp_layer *layer, uint32_t row, const int32_t *x, int64_t sums[4]) {
  int64_t bias[ROWS_PER_BLOCK];
  for (uint32_t i = 0U; i < ROWS_PER_BLOCK; ++i) {
    bias[i] = qjp_long(layer->bias + 2U * (row + i));
  }
  sums_scalar(layer->weights + row * layer->padded_columns, bias, x, layer->padded_columns, sums);
}

static void hidden_layer(const qjp_layer *layer, const int32_t *x, int32_t *y, uint32_t *trace) {
  for (uint32_t row = 0U; row < layer->padded_rows; row += ROWS_PER_BLOCK) {
    int64_t sums[ROWS_PER_BLOCK];
    block_sums(layer, row, x, sums);
    for (uint32_t i = 0U; i < ROWS_PER_BLOCK; ++i) {
      y[row + i] = relu_upper_word(sums[i]);
    }
    if ((trace != 0) && (row < layer->rows)) {
      const uint32_t left = layer->rows - row;
      digest_sums(trace, sums, (left < ROWS_PER_BLOCK) ? left : ROWS_PER_BLOCK);
    }
  }
}

static int32_t clamp_input(int32_t value) {
  value = (value > QJP_INPUT_ONE) ? QJP_INPUT_ONE : value;
  return (value < -QJP_INPUT_ONE) ? -QJP_INPUT_ONE : value;
}

/* Clamped in the accumulator's own units: a limit is below 2^31 and the shift at most 32. */
static int32_t output_command(const qjp_policy *policy, int64_t sum, uint32_t i) {
  const int64_t unit = INT64_C(1) << policy->output_shift;
  const int64_t low = policy->low[i] * unit;
  const int64_t high = policy->high[i] * unit;
  sum = (sum < low) ? low : sum;
  sum = (sum > high) ? high : sum;
  return (int32_t)(sum >> policy->output_shift);
}

void qjp_forward(const qjp_policy *policy, const int32_t *q, int32_t command[QJP_COMMANDS],
                 uint32_t *trace) {
  QJP_BUFFER int32_t buffer[2][QJP_MAX_WIDTH];
  int64_t sums[ROWS_PER_BLOCK];
  const uint32_t last = policy->layers - 1U;
  for (uint32_t i = 0U; i < policy->layer[0].padded_columns; ++i) {
    buffer[0][i] = (i < policy->inputs) ? clamp_input(q[i]) : 0;
  }
  if (trace != 0) {
    *trace = DIGEST_START;
  }
  for (uint32_t i = 0U; i < last; ++i) {
    hidden_layer(&policy->layer[i], buffer[i & 1U], buffer[(i + 1U) & 1U], trace);
  }
  block_sums(&policy->layer[last], 0U, buffer[last & 1U], sums);
  if (trace != 0) {
    digest_sums(trace, sums, QJP_COMMANDS);
  }
  for (uint32_t i = 0U; i < QJP_COMMANDS; ++i) {
    command[i] = output_command(policy, sums[i], i);
  }
}

void qjp_commands(const qjp_policy *policy, const int32_t q[QJP_COMMANDS],
                  float command[QJP_COMMANDS]) {
  const float unit = 1.0F / (float)(UINT32_C(1) << policy->fraction_bits); /* a power of two */
  for (uint32_t i = 0U; i < QJP_COMMANDS; ++i) {
    command[i] = (float)q[i] * unit;
  }
}

/* ---- the observation ---------------------------------------------------------------------------- */

/* 2^32 / (2 pi): a yaw in Q24 times this is in turns of 2^56. */
#define TURNS_PER_UNIT INT64_C(${turns_per_unit})
#define TURN_SHIFT 56
#define TWO_PI INT64_C(${two_pi}) /* Q30 */
/* Products of a quaternion are in Q58; elements of its matrix are held to +-2. */
#define QUATERNION_ONE (INT64_C(1) << 58)
#define MATRIX_SHIFT 28
#define MATRIX_LIMIT (INT64_C(1) << 31)

static void flag(uint32_t *mask, uint32_t i, uint32_t set) { *mask |= set << ((i < 31U) ? i : 31U); }

static const int32_t *gate_of(const qjp_policy *policy, uint32_t target) {
  const uint32_t number = (target < policy->gates) ? target : 0U;
  return policy->gate + number * (QJP_GATE_WORDS + policy->constants);
}

/* Through the gate and to its right: coordinates of at most 2^31 times at most 2^30, twice. */
static int64_t along(const int32_t *gate, int64_t x, int64_t y) {
  return gate[QJP_GATE_COSINE] * x + gate[QJP_GATE_SINE] * y;
}
static int64_t across(const int32_t *gate, int64_t x, int64_t y) {
  return gate[QJP_GATE_COSINE] * y - gate[QJP_GATE_SINE] * x;
}

/* Within half a turn, by one multiplication and no loop. */
static int64_t wrap(int64_t yaw) {
  const int64_t turns = ((yaw >> QJP_YAW_EXPONENT) * TURNS_PER_UNIT +
                         (INT64_C(1) << (TURN_SHIFT - 1))) >> TURN_SHIFT;
  return yaw - turns * TWO_PI;
}

/* An element of the rotation matrix: a sum of products in Q58, to Q30. */
static int64_t element(int64_t sum) {
  const int64_t value = round_shift(sum, MATRIX_SHIFT);
  return (value > MATRIX_LIMIT) ? MATRIX_LIMIT : ((value < -MATRIX_LIMIT) ? -MATRIX_LIMIT : value);
}

/* A vector of which the third number is along the gate's down, to three inputs before clipping. */
static void see_vector(const int32_t *gate, const int64_t v[3], int32_t shift, int64_t to[3]) {
  to[0] = round_shift(along(gate, v[0], v[1]), shift);
  to[1] = round_shift(across(gate, v[0], v[1]), shift);
  to[2] = round_shift(v[2] * (INT64_C(1) << QJP_Q30), shift);
}

static void see_rotation(const int32_t *gate, const int32_t *s, int32_t exponent, int64_t to[6]) {
  const int64_t w = s[0];
  const int64_t x = s[1];
  const int64_t y = s[2];
  const int64_t z = s[3];
  const int64_t front[3] = {element(QUATERNION_ONE - 2 * (y * y + z * z)),
                            element(2 * (x * y + w * z)), element(2 * (x * z - w * y))};
  const int64_t down[3] = {element(2 * (x * z + w * y)), element(2 * (y * z - w * x)),
                           element(QUATERNION_ONE - 2 * (x * x + y * y))};
  see_vector(gate, front, QJP_Q30 + exponent, to);
  see_vector(gate, down, QJP_Q30 + exponent, to + 3);
}

/* Inputs of a field that are not those of one number each. */
static void see(const qjp_policy *policy, const int32_t *part, const int32_t *s, const int32_t *gate,
                int64_t to[6]) {
  const int32_t first = policy->input[QJP_INPUT_WORDS * part[1]];
  const int32_t shift = QJP_Q30 - policy->exponents[first] + part[3];
  const int64_t yaw = s[first + 2] * (INT64_C(1) << QJP_YAW_EXPONENT) - qjp_long(gate + QJP_GATE_YAW);
  int64_t v[3] = {s[first], s[first + 1], s[first + 2]};
  switch (part[0]) {
    case QJP_SEE_POSITION:
      for (uint32_t i = 0U; i < 3U; ++i) {
        v[i] -= gate[i];
      }
      see_vector(gate, v, shift, to);
      break;
    case QJP_SEE_VELOCITY:
      see_vector(gate, v, shift, to);
      break;
    case QJP_SEE_ATTITUDE:
      to[0] = v[0];
      to[1] = v[1];
      to[2] = round_shift(wrap(yaw), part[3]);
      break;
    default: /* QJP_SEE_ROTATION */
      see_rotation(gate, s + first, part[3], to);
      break;
  }
}

/* One input of a field of numbers. */
static int64_t see_number(const int32_t *part, const int32_t *input, const int32_t *s,
                          const int32_t *gate) {
  if (part[0] == QJP_SEE_GATE) {
    return gate[QJP_GATE_WORDS + input[0]];
  }
  if (part[0] == QJP_SEE_COPY) {
    return s[input[0]];
  }
  return round_shift(((int64_t)s[input[0]] - input[1]) * input[2], input[3]);
}

/* Into the network's range, and whether it was outside. */
static int32_t hold(int64_t value, uint32_t *outside, uint32_t input) {
  const int64_t high = (value > QJP_INPUT_ONE) ? QJP_INPUT_ONE : value;
  const int64_t held = (high < -QJP_INPUT_ONE) ? -QJP_INPUT_ONE : high;
  flag(outside, input, (held != value) ? 1U : 0U);
  return (int32_t)held;
}

static qjp_status quantize_state(const qjp_policy *policy, const float *state, int32_t *s) {
  qjp_status status = {0U, 0U, 0U};
  for (uint32_t i = 0U; i < policy->state_size; ++i) {
    uint32_t clipped;
    uint32_t nan;
    s[i] = qjp_quantize_one(float_bits(state[i]), policy->exponents[i], &clipped, &nan);
    flag(&status.clipped, i, clipped);
    flag(&status.nan, i, nan);
  }
  return status;
}

qjp_status qjp_observe(const qjp_policy *policy, const float *state, uint32_t target, int32_t *q) {
  QJP_BUFFER int32_t s[QJP_MAX_STATE];
  const int32_t *const gate = gate_of(policy, target);
  qjp_status status = quantize_state(policy, state, s);
  for (uint32_t number = 0U; number < policy->parts; ++number) {
    const int32_t *const part = policy->part + QJP_PART_WORDS * number;
    int64_t seen[6] = {0};
    if (part[0] < QJP_SEE_COPY) {
      see(policy, part, s, gate, seen);
    }
    for (uint32_t i = 0U; i < (uint32_t)part[2]; ++i) {
      const uint32_t at = (uint32_t)part[1] + i;
      const int32_t *const input = policy->input + QJP_INPUT_WORDS * at;
      const int64_t value = (part[0] < QJP_SEE_COPY) ? seen[i] : see_number(part, input, s, gate);
      q[at] = hold(value, &status.outside, at);
    }
  }
  return status;
}

/* ---- the race ----------------------------------------------------------------------------------- */

static uint32_t quantize_position(const qjp_policy *policy, const float position[3], int32_t p[3]) {
  const int32_t first = qjp_find(policy, QJP_POSITION)[1];
  uint32_t unusable = 0U;
  for (uint32_t i = 0U; i < 3U; ++i) {
    uint32_t clipped;
    uint32_t nan;
    p[i] = qjp_quantize_one(float_bits(position[i]), policy->exponents[first], &clipped, &nan);
    unusable |= clipped | nan;
  }
  return unusable;
}

void qjp_race_start(const qjp_policy *policy, qjp_race *race, const float position[3],
                    uint32_t target) {
  (void)quantize_position(policy, position, race->previous);
  race->target = (target < policy->gates) ? target : 0U;
  race->passed = 0U;
  race->missed = 0U;
}

static int64_t magnitude(int64_t value) { return (value < 0) ? -value : value; }

/* A vector along one of the gate's axes: three products of at most 2^61. */
static int64_t on_axis(const int32_t *gate, uint32_t number, const int64_t v[3]) {
  const int32_t *const axis = gate + QJP_GATE_AXES + 3U * number;
  return axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2];
}

/* Whether a point relative to the gate's center is in the opening: along the world's axes or its own. */
static uint32_t is_inside(const qjp_policy *policy, const int32_t *gate, const int64_t v[3]) {
  const int64_t half_width = gate[QJP_GATE_HALF_WIDTH];
  const int64_t half_height = gate[QJP_GATE_HALF_HEIGHT];
  if (policy->world_box != 0U) {
    return ((magnitude(v[0]) < half_width) && (magnitude(v[1]) < half_width) &&
            (magnitude(v[2]) < half_height)) ? 1U : 0U;
  }
  const int64_t right = magnitude(round_shift(on_axis(gate, 1U, v), QJP_Q30));
  const int64_t down = magnitude(round_shift(on_axis(gate, 2U, v), QJP_Q30));
  if ((right > half_width) || (down > half_height)) {
    return 0U;
  }
  if ((gate[QJP_GATE_ROUND] == 0) || (down > half_width)) {
    return (gate[QJP_GATE_ROUND] == 0) ? 1U : 0U;
  }
  return (right * right + down * down <= half_width * half_width) ? 1U : 0U;
}

static qjp_event crossing(const qjp_policy *policy, const qjp_race *race, const int32_t now[3]) {
  const int32_t *const gate = gate_of(policy, race->target);
  int64_t before[3];
  int64_t after[3];
  for (uint32_t i = 0U; i < 3U; ++i) {
    before[i] = (int64_t)race->previous[i] - gate[i];
    after[i] = (int64_t)now[i] - gate[i];
  }
  if ((on_axis(gate, 0U, before) >= 0) || (on_axis(gate, 0U, after) < 0)) {
    return QJP_NO_EVENT;
  }
  return (is_inside(policy, gate, after) != 0U) ? QJP_GATE_PASSED : QJP_GATE_MISSED;
}

qjp_event qjp_race_update(const qjp_policy *policy, qjp_race *race, const float position[3]) {
  int32_t now[3];
  race->target = (race->target < policy->gates) ? race->target : 0U;
  if (quantize_position(policy, position, now) != 0U) {
    return QJP_NO_EVENT;
  }
  const qjp_event event = crossing(policy, race, now);
  if (event == QJP_GATE_PASSED) {
    race->target = (race->target + 1U < policy->gates) ? race->target + 1U : 0U;
    ++race->passed;
  } else if (event == QJP_GATE_MISSED) {
    ++race->missed;
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    race->previous[i] = now[i];
  }
  return event;
}
