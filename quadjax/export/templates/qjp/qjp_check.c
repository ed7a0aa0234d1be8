/* Checks of the contents of a .qjp file, and the proof that no input can overflow: see qjp.h. */
#include "qjp_layout.h"

enum {
  MAX_SHIFT = 60, /* of a product below 2^62.6 that is rounded */
  MAX_EXPONENT = 30,
  MAX_FRACTION = 30,
  LARGEST_HIDDEN = (1 << 30) - 1
};
#define ACCUMULATOR (UINT64_C(1) << 63)

/* ---- the numbers of the header, the state, the observation and the track ------------------------- */

static qjp_error check_header(const qjp_policy *policy) {
  uint32_t seen = 0U;
  uint32_t fine = qjp_within((int32_t)policy->world_box, 0, 1) &
                  qjp_within((int32_t)policy->kind, QJP_RPM, QJP_OTHER) &
                  qjp_within((int32_t)policy->output_shift, 1, 32) &
                  qjp_within((int32_t)policy->fraction_bits, 0, MAX_FRACTION) &
                  qjp_within((int32_t)policy->period_ns, 1, INT32_MAX);
  for (uint32_t i = 0U; i < QJP_COMMANDS; ++i) {
    fine &= qjp_within(policy->places[i], QJP_FRONT_LEFT, QJP_REAR_LEFT);
    fine &= qjp_within(policy->low[i], -INT32_MAX, policy->high[i]);
    seen |= UINT32_C(1) << ((uint32_t)policy->places[i] & 31U);
  }
  fine &= (seen == 15U) ? 1U : 0U;
  fine &= (policy->name[31] == '\0') ? 1U : 0U;
  fine &= (policy->vehicle[15] == '\0') ? 1U : 0U;
  return (fine != 0U) ? QJP_OK : QJP_BAD_HEADER;
}

/* Every number of the state belongs to one field, and every code occurs once. */
static qjp_error check_state(const qjp_policy *policy) {
  uint32_t next = 0U;
  uint32_t codes = 0U;
  for (uint32_t i = 0U; i < policy->fields; ++i) {
    const int32_t *const field = policy->field + QJP_FIELD_WORDS * i;
    const int32_t size = (field[0] == QJP_QUATERNION) ? 4 : 3;
    if (qjp_within(field[0], QJP_POSITION, QJP_THRUST) == 0U) {
      return QJP_BAD_STATE;
    }
    const uint32_t bit = UINT32_C(1) << (uint32_t)field[0];
    const uint32_t motion = (field[0] <= QJP_RATES) ? 1U : 0U;
    if (((codes & bit) != 0U) || (field[1] != (int32_t)next) || (qjp_within(field[2], 1, 4) == 0U) ||
        ((motion != 0U) && (field[2] != size)) ||
        (((field[0] == QJP_ROTOR_SPEED) || (field[0] == QJP_LAST_COMMAND)) && (field[2] != 4))) {
      return QJP_BAD_STATE;
    }
    codes |= bit;
    next += (uint32_t)field[2];
  }
  for (uint32_t i = 0U; i < policy->state_size; ++i) {
    if (qjp_within(policy->exponents[i], -MAX_EXPONENT, MAX_EXPONENT) == 0U) {
      return QJP_BAD_STATE;
    }
  }
  const uint32_t has_position = (codes >> QJP_POSITION) & 1U;
  return ((next == policy->state_size) && (has_position != 0U)) ? QJP_OK : QJP_BAD_STATE;
}

/* A field of inputs that are computed together starts at the first number of a field of the state. */
static uint32_t is_vector(const qjp_policy *policy, const int32_t *part) {
  static const qjp_field code[] = {QJP_POSITION, QJP_VELOCITY, QJP_EULER, QJP_QUATERNION};
  const int32_t *const field = qjp_find(policy, code[part[0] - 1]);
  const int32_t first = policy->input[QJP_INPUT_WORDS * part[1]];
  if ((field == 0) || (first != field[1]) || (part[2] != ((part[0] == QJP_SEE_ROTATION) ? 6 : 3))) {
    return 0U;
  }
  const int32_t *const e = policy->exponents + first;
  switch (part[0]) {
    case QJP_SEE_ATTITUDE:
      return ((e[0] == part[3]) && (e[1] == part[3]) && (e[2] == QJP_YAW_EXPONENT)) ? 1U : 0U;
    case QJP_SEE_ROTATION:
      return ((e[0] == QJP_QUATERNION_EXPONENT) && (e[1] == e[0]) && (e[2] == e[0]) &&
              (e[3] == e[0])) ? qjp_within(part[3], 1 - QJP_Q30, MAX_SHIFT - QJP_Q30) : 0U;
    default:
      return ((e[1] == e[0]) && (e[2] == e[0])) ? qjp_within(QJP_Q30 - e[0] + part[3], 1, MAX_SHIFT)
                                                : 0U;
  }
}

static uint32_t is_number(const qjp_policy *policy, const int32_t *part, const int32_t *input) {
  if (part[0] == QJP_SEE_GATE) {
    return qjp_within(input[0], 0, (int32_t)policy->constants - 1);
  }
  const uint32_t known = qjp_within(input[0], 0, (int32_t)policy->state_size - 1);
  if ((part[0] == QJP_SEE_COPY) && (known != 0U)) {
    return (policy->exponents[input[0]] == part[3]) ? 1U : 0U;
  }
  return known & qjp_within(input[3], 1, MAX_SHIFT);
}

static qjp_error check_observation(const qjp_policy *policy) {
  uint32_t next = 0U;
  for (uint32_t i = 0U; i < policy->parts; ++i) {
    const int32_t *const part = policy->part + QJP_PART_WORDS * i;
    uint32_t fine = qjp_within(part[0], QJP_SEE_POSITION, QJP_SEE_GATE) &
                    ((part[1] == (int32_t)next) ? 1U : 0U) &
                    qjp_within(part[2], 1, (int32_t)(policy->inputs - next)) &
                    qjp_within(part[3], -MAX_EXPONENT, MAX_EXPONENT);
    if (fine == 0U) {
      return QJP_BAD_OBSERVATION;
    }
    const int32_t *const input = policy->input + QJP_INPUT_WORDS * part[1];
    for (int32_t k = 0; (part[0] >= QJP_SEE_COPY) && (k < part[2]); ++k) {
      fine &= is_number(policy, part, input + QJP_INPUT_WORDS * k);
    }
    fine &= (part[0] < QJP_SEE_COPY) ? is_vector(policy, part) : 1U;
    if (fine == 0U) {
      return QJP_BAD_OBSERVATION;
    }
    next += (uint32_t)part[2];
  }
  return (next == policy->inputs) ? QJP_OK : QJP_BAD_OBSERVATION;
}

static qjp_error check_track(const qjp_policy *policy) {
  const int64_t farthest_yaw = INT64_C(1) << 36;
  for (uint32_t i = 0U; i < policy->gates; ++i) {
    const int32_t *const gate = policy->gate + i * (QJP_GATE_WORDS + policy->constants);
    const int64_t yaw = qjp_long(gate + QJP_GATE_YAW);
    uint32_t fine = ((yaw <= farthest_yaw) && (yaw >= -farthest_yaw)) ? 1U : 0U;
    for (uint32_t k = 0U; k <= QJP_GATE_SINE; ++k) {
      fine &= qjp_within(gate[k], -QJP_INPUT_ONE, QJP_INPUT_ONE);
    }
    fine &= qjp_within(gate[QJP_GATE_HALF_WIDTH], 0, INT32_MAX) &
            qjp_within(gate[QJP_GATE_HALF_HEIGHT], 0, INT32_MAX) &
            qjp_within(gate[QJP_GATE_ROUND], 0, 1);
    for (uint32_t k = 0U; k < policy->constants; ++k) {
      fine &= qjp_within(gate[QJP_GATE_WORDS + k], -QJP_INPUT_ONE, QJP_INPUT_ONE);
    }
    if (fine == 0U) {
      return QJP_BAD_TRACK;
    }
  }
  return QJP_OK;
}

/* ---- the proof ---------------------------------------------------------------------------------- */

/* Ranges of the inputs of a layer, and of what comes out. */
typedef struct {
  int32_t low[QJP_MAX_WIDTH];
  int32_t high[QJP_MAX_WIDTH];
} ranges;

typedef struct {
  uint64_t magnitude; /* |bias| + sum |w| max|x| */
  int64_t low;
  int64_t high;
  qjp_error error;
} row_range;

static uint64_t magnitude(int64_t value) {
  return (value < 0) ? 0U - (uint64_t)value : (uint64_t)value;
}

/* The exact range of a row's sum. No partial sum overflows here: each product is at most 2^61. */
static row_range range_of(const qjp_layer *layer, uint32_t row, const ranges *in, int64_t half) {
  const int32_t *weight = layer->weights +
                          (row & ~3U) * layer->padded_columns + (row & 3U);
  const int64_t bias = qjp_long(layer->bias + 2U * row);
  row_range range = {magnitude(bias), bias, bias, QJP_OK};
  uint32_t unused = (row >= layer->rows) ? (uint32_t)(bias != half) : 0U;
  for (uint32_t i = 0U; i < layer->padded_columns; ++i) {
    const int64_t w = weight[QJP_ROWS_PER_BLOCK * i];
    const int64_t a = w * ((w > 0) ? in->low[i] : in->high[i]);
    const int64_t b = w * ((w > 0) ? in->high[i] : in->low[i]);
    const uint64_t largest = (magnitude(a) > magnitude(b)) ? magnitude(a) : magnitude(b);
    unused |= ((w != 0) && ((row >= layer->rows) || (i >= layer->columns))) ? 1U : 0U;
    range.magnitude += largest;
    if (range.magnitude >= ACCUMULATOR) {
      range.error = QJP_BAD_CERTIFICATE;
      return range;
    }
    range.low += a;
    range.high += b;
  }
  range.error = (unused != 0U) ? QJP_BAD_PADDING : QJP_OK;
  return range;
}

/* Proves a layer, compares the result with its certificate, and replaces the ranges of its inputs. */
static qjp_error prove_layer(const qjp_policy *policy, uint32_t number, const ranges *in,
                             ranges *out) {
  const qjp_layer *const layer = &policy->layer[number];
  const int32_t *const stated = policy->certificate + QJP_LAYER_WORDS * number;
  const uint32_t hidden = (number + 1U < policy->layers) ? 1U : 0U;
  const int64_t half = INT64_C(1) << ((hidden != 0U) ? 31U : policy->output_shift - 1U);
  uint64_t largest_sum = 0U;
  int32_t largest = 0;
  for (uint32_t row = 0U; row < layer->padded_rows; ++row) {
    const row_range range = range_of(layer, row, in, half);
    if (range.error != QJP_OK) {
      return range.error;
    }
    const int64_t high = (range.high > 0) ? range.high >> 32 : 0;
    if ((hidden != 0U) && (high > LARGEST_HIDDEN)) {
      return QJP_BAD_CERTIFICATE;
    }
    out->low[row] = (range.low > 0) ? (int32_t)(range.low >> 32) : 0;
    out->high[row] = (int32_t)high;
    largest_sum = (range.magnitude > largest_sum) ? range.magnitude : largest_sum;
    largest = ((hidden != 0U) && (out->high[row] > largest)) ? out->high[row] : largest;
  }
  const uint64_t stated_sum = (uint64_t)qjp_long(stated + 2);
  return ((stated_sum == largest_sum) && (stated[4] == largest)) ? QJP_OK : QJP_BAD_CERTIFICATE;
}

static qjp_error prove(const qjp_policy *policy) {
  QJP_BUFFER ranges range[2];
  for (uint32_t i = 0U; i < QJP_MAX_WIDTH; ++i) {
    range[0].high[i] = (i < policy->inputs) ? QJP_INPUT_ONE : 0;
    range[0].low[i] = -range[0].high[i];
  }
  for (uint32_t i = 0U; i < policy->layers; ++i) {
    const qjp_error error = prove_layer(policy, i, &range[i & 1U], &range[(i + 1U) & 1U]);
    if (error != QJP_OK) {
      return error;
    }
  }
  return QJP_OK;
}

qjp_error qjp_check(const qjp_policy *policy) {
  static qjp_error (*const checks[])(const qjp_policy *) = {
      check_header, check_state, check_observation, check_track, prove};
  qjp_error error = QJP_OK;
  for (uint32_t i = 0U; (error == QJP_OK) && (i < sizeof(checks) / sizeof(checks[0])); ++i) {
    error = checks[i](policy);
  }
  return error;
}
