/* Checks of the contents of a policy's words, and the proof that no input can overflow: see qj.h. */
#include "qj_integers.h"

enum {
  MAX_SHIFT = 60, /* of a product below 2^62.6 that is rounded */
  MAX_EXPONENT = 30,
  LARGEST_HIDDEN = (1 << 30) - 1
};
#define ACCUMULATOR ((UINT64_C(1) << 63) - (UINT64_C(1) << 30)) /* with room for a rounding half */
#define ROOM (UINT64_C(1) << 62) /* sums and products of the estimators stay below */

/* ---- header, state, observation and track -------------------------------------------------------- */

static qj_error check_header(const qj_policy *policy) {
  const int32_t *const w = policy->words;
  uint32_t fine = qj_within(w[QJ_HEADER_WORLD_BOX], 0, 1) &
                  qj_within(w[QJ_HEADER_KIND], QJ_RPM, QJ_RATES_THRUST) &
                  qj_within(w[QJ_HEADER_OUTPUT_SHIFT], 1, 32) &
                  qj_within(w[QJ_HEADER_FRACTION_BITS], 0, 30) &
                  qj_within(w[QJ_HEADER_PERIOD_NS], 1, INT32_MAX);
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    fine &= qj_within(policy->low[i], -INT32_MAX, policy->high[i]);
  }
  fine &= ((uint32_t)w[QJ_HEADER_NAME + 7] < (UINT32_C(1) << 24)) ? 1U : 0U; /* they end with zero */
  fine &= ((uint32_t)w[QJ_HEADER_VEHICLE + 3] < (UINT32_C(1) << 24)) ? 1U : 0U;
  return (fine != 0U) ? QJ_OK : QJ_BAD_HEADER;
}

/* The numbers of a field; 0 for one that may have 1 to 4. */
static int32_t size_of(int32_t code) {
  switch (code) {
    case QJ_QUATERNION:
    case QJ_ROTOR_SPEED:
    case QJ_ROTOR_RPM:
    case QJ_LAST_COMMAND:
      return 4;
    case QJ_THRUST:
    case QJ_HIGHEST_RPM:
      return 1;
    default:
      return 3;
  }
}

/* Every number of the state belongs to one field, and every code occurs once. */
static qj_error check_state(const qj_policy *policy) {
  uint32_t next = 0U;
  uint32_t codes = 0U;
  for (uint32_t i = 0U; i < policy->fields; ++i) {
    const int32_t *const field = policy->field + QJ_FIELD_WORDS * i;
    if (qj_within(field[QJ_FIELD_CODE], QJ_POSITION, QJ_HIGHEST_RPM) == 0U) {
      return QJ_BAD_STATE;
    }
    const uint32_t bit = UINT32_C(1) << (uint32_t)field[QJ_FIELD_CODE];
    if (((codes & bit) != 0U) || (field[QJ_FIELD_START] != (int32_t)next) ||
        (field[QJ_FIELD_SIZE] != size_of(field[QJ_FIELD_CODE]))) {
      return QJ_BAD_STATE;
    }
    codes |= bit;
    next += (uint32_t)field[QJ_FIELD_SIZE];
  }
  for (uint32_t i = 0U; i < policy->state_size; ++i) {
    if (qj_within(policy->exponents[i], -MAX_EXPONENT, MAX_EXPONENT) == 0U) {
      return QJ_BAD_STATE;
    }
  }
  return ((next == policy->state_size) && ((codes >> QJ_POSITION & 1U) != 0U)) ? QJ_OK
                                                                               : QJ_BAD_STATE;
}

/* Numbers of an input that is not scaled. */
static uint32_t is_plain(const int32_t *input) {
  return ((input[QJ_INPUT_MIDDLE] == 0) && (input[QJ_INPUT_FACTOR] == 0) &&
          (input[QJ_INPUT_SHIFT] == 1)) ? 1U : 0U;
}

/* Inputs that are computed together start at the first number of a field of the state. */
static uint32_t is_vector(const qj_policy *policy, const int32_t *part) {
  static const int32_t code[] = {QJ_POSITION, QJ_VELOCITY, QJ_EULER, QJ_QUATERNION};
  const int32_t kind = part[QJ_PART_KIND];
  const int32_t exponent = part[QJ_PART_EXPONENT];
  const int32_t *const field = qj_find_field(policy, code[kind - QJ_SEE_POSITION]);
  const int32_t first = policy->input[QJ_INPUT_WORDS * part[QJ_PART_INDEX] + QJ_INPUT_SOURCE];
  if ((field == 0) || (first != field[QJ_FIELD_START]) ||
      (part[QJ_PART_SIZE] != ((kind == QJ_SEE_ROTATION) ? 6 : 3))) {
    return 0U;
  }
  for (int32_t k = 0; k < part[QJ_PART_SIZE]; ++k) {
    const int32_t *const input = policy->input + QJ_INPUT_WORDS * (part[QJ_PART_INDEX] + k);
    const int32_t source = first + ((kind == QJ_SEE_ROTATION) ? 0 : k);
    if ((input[QJ_INPUT_SOURCE] != source) || (is_plain(input) == 0U)) {
      return 0U;
    }
  }
  const int32_t *const e = policy->exponents + first;
  switch (kind) {
    case QJ_SEE_ATTITUDE:
      return ((e[0] == exponent) && (e[1] == exponent) && (e[2] == QJ_YAW_EXPONENT)) ? 1U : 0U;
    case QJ_SEE_ROTATION:
      return ((e[0] == QJ_QUATERNION_EXPONENT) && (e[1] == e[0]) && (e[2] == e[0]) &&
              (e[3] == e[0])) ? qj_within(exponent, 1 - Q30, MAX_SHIFT - Q30) : 0U;
    default:
      return ((e[1] == e[0]) && (e[2] == e[0])) ? qj_within(Q30 - e[0] + exponent, 1, MAX_SHIFT)
                                                : 0U;
  }
}

static uint32_t is_number(const qj_policy *policy, const int32_t *part, const int32_t *input) {
  const int32_t source = input[QJ_INPUT_SOURCE];
  if ((part[QJ_PART_KIND] != QJ_SEE_SCALED) && (is_plain(input) == 0U)) {
    return 0U;
  }
  if (part[QJ_PART_KIND] == QJ_SEE_GATE) {
    return qj_within(source, 0, policy->words[QJ_HEADER_CONSTANTS] - 1);
  }
  if (qj_within(source, 0, (int32_t)policy->state_size - 1) == 0U) {
    return 0U;
  }
  if (part[QJ_PART_KIND] == QJ_SEE_COPY) {
    return (policy->exponents[source] == part[QJ_PART_EXPONENT]) ? 1U : 0U;
  }
  return qj_within(input[QJ_INPUT_SHIFT], 1, MAX_SHIFT) &
         qj_within(input[QJ_INPUT_FACTOR], -INT32_MAX, INT32_MAX) &
         qj_within(input[QJ_INPUT_MIDDLE], -INT32_MAX, INT32_MAX);
}

static qj_error check_observation(const qj_policy *policy) {
  uint32_t next = 0U;
  for (uint32_t i = 0U; i < policy->parts; ++i) {
    const int32_t *const part = policy->part + QJ_PART_WORDS * i;
    uint32_t fine = qj_within(part[QJ_PART_KIND], QJ_SEE_POSITION, QJ_SEE_GATE) &
                    ((part[QJ_PART_INDEX] == (int32_t)next) ? 1U : 0U) &
                    qj_within(part[QJ_PART_SIZE], 1, (int32_t)(policy->inputs - next)) &
                    qj_within(part[QJ_PART_EXPONENT], -MAX_EXPONENT, MAX_EXPONENT);
    if (fine == 0U) {
      return QJ_BAD_OBSERVATION;
    }
    const int32_t *const input = policy->input + QJ_INPUT_WORDS * part[QJ_PART_INDEX];
    const uint32_t vector = (part[QJ_PART_KIND] < QJ_SEE_COPY) ? 1U : 0U;
    for (int32_t k = 0; (vector == 0U) && (k < part[QJ_PART_SIZE]); ++k) {
      fine &= is_number(policy, part, input + QJ_INPUT_WORDS * k);
    }
    fine &= (vector != 0U) ? is_vector(policy, part) : 1U;
    if (fine == 0U) {
      return QJ_BAD_OBSERVATION;
    }
    next += (uint32_t)part[QJ_PART_SIZE];
  }
  return (next == policy->inputs) ? QJ_OK : QJ_BAD_OBSERVATION;
}

static qj_error check_track(const qj_policy *policy) {
  for (uint32_t i = 0U; i < policy->gates; ++i) {
    const int32_t *const gate = policy->gate + i * policy->gate_words;
    uint32_t fine = qj_within(qj_long(gate + QJ_GATE_YAW), -(INT64_C(1) << 36), INT64_C(1) << 36) &
                    qj_within(gate[QJ_GATE_HALF_WIDTH], 0, INT32_MAX) &
                    qj_within(gate[QJ_GATE_HALF_HEIGHT], 0, INT32_MAX) &
                    qj_within(gate[QJ_GATE_ROUND], 0, 1);
    for (uint32_t k = 0U; k <= QJ_GATE_SINE; ++k) {
      fine &= qj_within(gate[k], -QJ_INPUT_ONE, QJ_INPUT_ONE);
    }
    for (uint32_t k = QJ_GATE_WORDS; k < policy->gate_words; ++k) {
      fine &= qj_within(gate[k], -QJ_INPUT_ONE, QJ_INPUT_ONE);
    }
    if (fine == 0U) {
      return QJ_BAD_TRACK;
    }
  }
  return QJ_OK;
}

/* ---- the proof ---------------------------------------------------------------------------------- */

/* Ranges of the inputs of a layer, and of what comes out. */
typedef struct {
  int32_t low[QJ_MAX_WIDTH];
  int32_t high[QJ_MAX_WIDTH];
} ranges;

static uint64_t absolute(int64_t value) {
  return (value < 0) ? 0U - (uint64_t)value : (uint64_t)value;
}

/* The exact range of a row's sum. No partial sum overflows here: each product is at most 2^61. */
static qj_error range_of(const qj_layer *layer, uint32_t row, const ranges *in, int64_t half,
                         int64_t *low, int64_t *high) {
  const int32_t *weight = layer->weights + (row & ~3U) * layer->padded_columns + (row & 3U);
  const int64_t bias = qj_long(layer->bias + 2U * row);
  uint32_t unused = (row >= layer->rows) ? (uint32_t)(bias != half) : 0U;
  uint64_t largest = absolute(bias); /* |bias| + sum |w| max|x| */
  *low = bias;
  *high = bias;
  for (uint32_t i = 0U; i < layer->padded_columns; ++i) {
    const int64_t w = weight[4U * i];
    const int64_t a = w * ((w > 0) ? in->low[i] : in->high[i]);
    const int64_t b = w * ((w > 0) ? in->high[i] : in->low[i]);
    unused |= ((w != 0) && ((row >= layer->rows) || (i >= layer->columns))) ? 1U : 0U;
    largest += (absolute(a) > absolute(b)) ? absolute(a) : absolute(b);
    if (largest >= ACCUMULATOR) {
      return QJ_BAD_RANGES;
    }
    *low += a;
    *high += b;
  }
  return (unused != 0U) ? QJ_BAD_PADDING : QJ_OK;
}

/* Proves a layer; the ranges of its outputs. */
static qj_error prove_layer(const qj_layer *layer, uint32_t hidden, int64_t half, const ranges *in,
                            ranges *out) {
  for (uint32_t row = 0U; row < layer->padded_rows; ++row) {
    int64_t low;
    int64_t high;
    const qj_error error = range_of(layer, row, in, half, &low, &high);
    if (error != QJ_OK) {
      return error;
    }
    high = (high > 0) ? high >> WORD : 0;
    if ((hidden != 0U) && (high > LARGEST_HIDDEN)) {
      return QJ_BAD_RANGES;
    }
    out->low[row] = (low > 0) ? (int32_t)(low >> WORD) : 0;
    out->high[row] = (int32_t)high;
  }
  return QJ_OK;
}

/* half: that is folded into the output's padded rows. */
static qj_error prove(const qj_layer *layer, uint32_t count, int64_t half) {
  ranges range[2];
  for (uint32_t i = 0U; i < QJ_MAX_WIDTH; ++i) {
    range[0].high[i] = (i < layer->columns) ? QJ_INPUT_ONE : 0;
    range[0].low[i] = -range[0].high[i];
  }
  for (uint32_t i = 0U; i < count; ++i) {
    const uint32_t hidden = (i + 1U < count) ? 1U : 0U;
    const qj_error error = prove_layer(&layer[i], hidden, (hidden != 0U) ? INT64_C(1) << 31 : half,
                                       &range[i & 1U], &range[(i + 1U) & 1U]);
    if (error != QJ_OK) {
      return error;
    }
  }
  return QJ_OK;
}

/* ---- the estimators ----------------------------------------------------------------------------- */

static uint32_t bit_length(uint64_t value) {
  uint32_t bits = 0U;
  for (; value != 0U; value >>= 1) {
    ++bits;
  }
  return bits;
}

/* Whether a product is below 2^62, by the bits of its factors. */
static uint32_t fits(uint64_t value, uint64_t factor) {
  return (bit_length(value) + bit_length(factor) <= 62U) ? 1U : 0U;
}

/* The same of a product of more than 64 bits in two parts, of value / 2^16 and of 16 bits. */
static uint32_t scaled_fits(uint64_t value, int64_t factor) {
  return fits((value >> 16) + 1U, absolute(factor) + 1U) & fits(0xFFFFU, absolute(factor));
}

/* Sums of the model, and the filter's products; what the filter gives is clamped. */
static uint32_t terms_fit(const qj_policy *policy) {
  static const uint8_t bound[QJ_MONOMIALS] = {1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 2, 2, 4, 4, 4, 4, 4, 2};
  const int32_t *const e = policy->estimator;
  const int64_t gain = qj_long(e + QJ_ESTIMATOR_GAIN);
  uint64_t sums[2 * QJ_CHANNELS] = {0};
  uint32_t fine = 1U;
  int32_t last = -1;
  for (int32_t i = 0; i < e[QJ_ESTIMATOR_TERMS]; ++i) {
    const int32_t *const term = policy->terms + QJ_TERM_WORDS * i;
    if ((qj_within(term[QJ_TERM_CHANNEL], 0, QJ_CHANNELS + 2) &
         qj_within(term[QJ_TERM_MONOMIAL], 0, QJ_MONOMIALS - 1)) == 0U) {
      return 0U;
    }
    const int32_t number = term[QJ_TERM_CHANNEL] * QJ_MONOMIALS + term[QJ_TERM_MONOMIAL];
    if ((number <= last) || (qj_long(term + QJ_TERM_FACTOR) == 0)) {
      return 0U; /* in order, each once */
    }
    last = number;
    const uint64_t factor = absolute(qj_long(term + QJ_TERM_FACTOR));
    const uint64_t largest = ((uint64_t)bound[term[QJ_TERM_MONOMIAL]] << Q30) + 2U;
    uint64_t *const sum = &sums[term[QJ_TERM_CHANNEL]];
    if ((fits(factor, largest) == 0U) || (*sum >= ROOM)) {
      return 0U;
    }
    *sum += factor * largest;
  }
  for (uint32_t i = 0U; i < QJ_CHANNELS; ++i) {
    const uint64_t x = (sums[i] >> 14) + 2U + (UINT64_C(1) << (QJ_FINE_BITS - 1));
    const uint64_t d = (sums[QJ_CHANNELS + i] >> 10) + 2U;
    fine &= ((sums[i] < ROOM) && (sums[QJ_CHANNELS + i] < ROOM) && (x + d < ROOM / 8U)) ? 1U : 0U;
    fine &= scaled_fits(2U * (x + d), gain);
  }
  const uint64_t limit = UINT64_C(1) << QJ_FINE_BITS;
  return fine & scaled_fits(limit, qj_long(e + QJ_ESTIMATOR_A1)) &
         scaled_fits(limit, qj_long(e + QJ_ESTIMATOR_A2));
}

static qj_error check_estimator(const qj_policy *policy) {
  const int32_t *const e = policy->estimator;
  if (e == 0) {
    return QJ_OK;
  }
  uint32_t fine = qj_within(e[QJ_ESTIMATOR_PERIOD_NS], 1, INT32_MAX);
  for (uint32_t i = 0U; i < QJ_MEASUREMENTS + QJ_CHANNELS; ++i) { /* the channels follow */
    fine &= qj_within(e[QJ_ESTIMATOR_EXPONENTS + i], -96, 96);
  }
  if ((fine == 0U) || (terms_fit(policy) == 0U)) {
    return QJ_BAD_ESTIMATOR;
  }
  if (e[QJ_ESTIMATOR_THRUST_LAYERS] == 0) {
    uint32_t numbers = 0U; /* of networks that there are not */
    for (uint32_t i = QJ_ESTIMATOR_RPM_MIDDLE; i < QJ_ESTIMATOR_A1; ++i) {
      numbers |= (uint32_t)e[i];
    }
    return (numbers == 0U) ? QJ_OK : QJ_BAD_ESTIMATOR;
  }
  fine = qj_within(e[QJ_ESTIMATOR_RPM_SHIFT], 1, MAX_SHIFT) &
         qj_within(e[QJ_ESTIMATOR_RPM_MIDDLE], -QJ_INPUT_ONE, QJ_INPUT_ONE);
  for (uint32_t i = 0U; i < 4U; ++i) { /* one of the thrust, three of the moment */
    fine &= qj_within(e[QJ_ESTIMATOR_THRUST_SHIFT + i], 1, Q30);
  }
  if (fine == 0U) {
    return QJ_BAD_ESTIMATOR;
  }
  const qj_error error =
      prove(&policy->layer[policy->layers], (uint32_t)e[QJ_ESTIMATOR_THRUST_LAYERS], 0);
  return (error != QJ_OK) ? error
                          : prove(&policy->layer[qj_moment_layer(policy)],
                                  (uint32_t)e[QJ_ESTIMATOR_MOMENT_LAYERS], 0);
}

/* A factor of 30 bits with its shift. */
static uint32_t is_factor(const int32_t *factor) {
  return qj_within(factor[0], 0, QJ_INPUT_ONE) & qj_within(factor[1], 17, MAX_SHIFT);
}

/* The low-pass factor is at most one, so that speeds stay within their range, and limited in 0 .. 1. */
static qj_error check_battery(const qj_policy *policy) {
  const int32_t *const b = policy->battery;
  if (b == 0) {
    return QJ_OK;
  }
  const uint64_t full = UINT64_C(1) << QJ_BATTERY_BITS;
  const uint64_t lead = (uint64_t)b[QJ_BATTERY_LEAD];
  const int64_t lowest = qj_long(b + QJ_BATTERY_LOWEST);
  const int64_t highest = qj_long(b + QJ_BATTERY_HIGHEST);
  const uint32_t fine = qj_within(b[QJ_BATTERY_PERIOD_NS], 1, INT32_MAX) &
                        qj_within(b[QJ_BATTERY_EXPONENT], -MAX_EXPONENT, MAX_EXPONENT) &
                        is_factor(b + QJ_BATTERY_LOW_PASS) & is_factor(b + QJ_BATTERY_LEAD) &
                        is_factor(b + QJ_BATTERY_GAIN) & qj_within(lowest, 0, highest) &
                        qj_within(highest, lowest, (int64_t)full) &
                        qj_within(qj_long(b + QJ_BATTERY_FIRST), lowest, highest);
  if ((fine == 0U) ||
      (b[QJ_BATTERY_LOW_PASS] > (INT64_C(1) << (uint32_t)b[QJ_BATTERY_LOW_PASS_SHIFT]))) {
    return QJ_BAD_ESTIMATOR;
  }
  /* 2 full times the lead, in two parts below 2^56, and of one motor at most: */
  const uint64_t error = 2U * full + 2U +
                         (((2U * full >> 16) * lead) >> ((uint32_t)b[QJ_BATTERY_LEAD_SHIFT] - 16U)) + 1U;
  return ((scaled_fits(error, INT64_C(1) << 30) & scaled_fits(4U * (error + 1U), b[QJ_BATTERY_GAIN])) !=
          0U) ? QJ_OK : QJ_BAD_ESTIMATOR;
}

#ifdef QJ_SAMPLED
static qj_error check_noise(const qj_policy *policy) {
  uint32_t fine = 1U;
  for (uint32_t i = 0U; (policy->noise != 0) && (i < QJ_COMMANDS); ++i) {
    fine &= qj_within(policy->noise[QJ_NOISE_FACTOR + i], 0, INT32_MAX);
  }
  fine &= (policy->noise != 0) ? qj_within(policy->noise[QJ_NOISE_ON_CLAMPED], 0, 1) : 1U;
  return (fine != 0U) ? QJ_OK : QJ_BAD_RANGES;
}
#endif

qj_error qj_check(const qj_policy *policy) {
  static qj_error (*const checks[])(const qj_policy *) = {
      check_header, check_state,     check_observation, check_track, check_estimator,
      check_battery,
#ifdef QJ_SAMPLED
      check_noise,
#endif
  };
  qj_error error = QJ_OK;
  for (uint32_t i = 0U; (error == QJ_OK) && (i < sizeof(checks) / sizeof(checks[0])); ++i) {
    error = checks[i](policy);
  }
  return (error != QJ_OK) ? error
                          : prove(policy->layer, policy->layers,
                                  INT64_C(1) << (policy->output_shift - 1U));
}
