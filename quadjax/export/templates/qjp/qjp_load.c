/* Checks of a .qjp file: see qjp.h. Nothing after the hash is used before it is checked. */
#include "qjp_layout.h"

enum { MAX_COUNT = 4096 }; /* of gates and of self-tests: so that no size overflows */

static uint32_t padded(uint32_t count, uint32_t multiple) {
  return (count + multiple - 1U) / multiple * multiple;
}

const int32_t *qjp_find(const qjp_policy *policy, qjp_field code) {
  for (uint32_t i = 0U; i < policy->fields; ++i) {
    if (policy->field[QJP_FIELD_WORDS * i] == (int32_t)code) {
      return policy->field + QJP_FIELD_WORDS * i;
    }
  }
  return 0;
}

/* ---- sizes and the hash ------------------------------------------------------------------------- */

static qjp_error check_counts(const int32_t *words) {
  const uint32_t small = qjp_within(words[QJP_AT_LAYERS], 1, QJP_MAX_LAYERS) &
                         qjp_within(words[QJP_AT_INPUTS], 1, QJP_MAX_WIDTH) &
                         qjp_within(words[QJP_AT_STATE_SIZE], 1, QJP_MAX_STATE);
  const uint32_t allowed = qjp_within(words[QJP_AT_FIELDS], 1, QJP_MAX_STATE) &
                           qjp_within(words[QJP_AT_PARTS], 1, QJP_MAX_WIDTH) &
                           qjp_within(words[QJP_AT_GATES], 1, MAX_COUNT) &
                           qjp_within(words[QJP_AT_CONSTANTS], 0, QJP_MAX_WIDTH) &
                           qjp_within(words[QJP_AT_NETWORK_TESTS], 1, MAX_COUNT) &
                           qjp_within(words[QJP_AT_RACE_TESTS], 1, MAX_COUNT) &
                           qjp_within(words[QJP_AT_OUTPUTS], QJP_COMMANDS, QJP_COMMANDS);
  if (allowed == 0U) {
    return QJP_BAD_HEADER;
  }
  return (small == 0U) ? QJP_TOO_LARGE : QJP_OK;
}

/* Where everything is; the sizes of the layers come from their certificates. */
static qjp_error find_tables(qjp_policy *policy, const int32_t *words, uint32_t count) {
  const int32_t *at = words + QJP_HEADER_WORDS;
  uint32_t columns = policy->inputs;
  uint32_t used = QJP_HEADER_WORDS + QJP_LAYER_WORDS * policy->layers +
                  QJP_FIELD_WORDS * policy->fields + policy->state_size +
                  QJP_PART_WORDS * policy->parts + QJP_INPUT_WORDS * policy->inputs +
                  (QJP_GATE_WORDS + policy->constants) * policy->gates;
  if (used > count) {
    return QJP_BAD_SIZE;
  }
  policy->certificate = at;
  policy->field = policy->certificate + QJP_LAYER_WORDS * policy->layers;
  policy->exponents = policy->field + QJP_FIELD_WORDS * policy->fields;
  policy->part = policy->exponents + policy->state_size;
  policy->input = policy->part + QJP_PART_WORDS * policy->parts;
  policy->gate = policy->input + QJP_INPUT_WORDS * policy->inputs;
  at = words + used;
  for (uint32_t i = 0U; i < policy->layers; ++i) {
    const int32_t *const stated = policy->certificate + QJP_LAYER_WORDS * i;
    qjp_layer *const layer = &policy->layer[i];
    if ((qjp_within(stated[0], 1, QJP_MAX_WIDTH) & qjp_within(stated[1], 1, QJP_MAX_WIDTH)) == 0U) {
      return QJP_TOO_LARGE;
    }
    layer->rows = (uint32_t)stated[0];
    layer->columns = (uint32_t)stated[1];
    layer->padded_rows = padded(layer->rows, (i + 1U < policy->layers) ? QJP_COLUMNS_PER_TURN
                                                                      : QJP_ROWS_PER_BLOCK);
    layer->padded_columns = padded(layer->columns, QJP_COLUMNS_PER_TURN);
    if ((layer->columns != columns) || (layer->padded_rows > QJP_MAX_WIDTH) ||
        (layer->padded_columns > QJP_MAX_WIDTH)) {
      return QJP_BAD_HEADER;
    }
    layer->weights = at;
    layer->bias = at + layer->padded_rows * layer->padded_columns;
    used += layer->padded_rows * (layer->padded_columns + 2U);
    if (used > count) {
      return QJP_BAD_SIZE;
    }
    at = words + used;
    columns = layer->rows;
  }
  policy->tests = at;
  used += policy->network_tests * (policy->inputs + QJP_COMMANDS + 1U) +
          policy->race_tests * (policy->state_size + 1U + policy->inputs + 3U);
  if (columns != QJP_COMMANDS) {
    return QJP_BAD_HEADER;
  }
  return (used == count) ? QJP_OK : QJP_BAD_SIZE;
}

static void read_header(qjp_policy *policy, const int32_t *words) {
  policy->inputs = (uint32_t)words[QJP_AT_INPUTS];
  policy->layers = (uint32_t)words[QJP_AT_LAYERS];
  policy->state_size = (uint32_t)words[QJP_AT_STATE_SIZE];
  policy->fields = (uint32_t)words[QJP_AT_FIELDS];
  policy->parts = (uint32_t)words[QJP_AT_PARTS];
  policy->gates = (uint32_t)words[QJP_AT_GATES];
  policy->constants = (uint32_t)words[QJP_AT_CONSTANTS];
  policy->world_box = (uint32_t)words[QJP_AT_WORLD_BOX];
  policy->kind = (uint32_t)words[QJP_AT_KIND];
  policy->output_shift = (uint32_t)words[QJP_AT_SHIFT];
  policy->fraction_bits = (uint32_t)words[QJP_AT_FRACTION];
  policy->period_ns = (uint32_t)words[QJP_AT_PERIOD];
  policy->network_tests = (uint32_t)words[QJP_AT_NETWORK_TESTS];
  policy->race_tests = (uint32_t)words[QJP_AT_RACE_TESTS];
  policy->source = (const uint8_t *)(words + QJP_AT_SOURCE);
  policy->name = (const char *)(words + QJP_AT_NAME);
  policy->vehicle = (const char *)(words + QJP_AT_VEHICLE);
  policy->places = words + QJP_AT_PLACES;
  policy->low = words + QJP_AT_LOW;
  policy->high = words + QJP_AT_HIGH;
}

static uint32_t is_changed(const int32_t *words, uint32_t count) {
  const uint8_t *const bytes = (const uint8_t *)words;
  uint8_t digest[32];
  uint32_t wrong = 0U;
  qjp_sha256(bytes, 4U * count, digest);
  for (uint32_t i = 0U; i < 32U; ++i) {
    wrong |= (uint32_t)(digest[i] ^ bytes[4U * count + i]);
  }
  return wrong;
}

/* ---- self-tests ----------------------------------------------------------------------------------- */

static uint32_t network_test_fails(const qjp_policy *policy, const int32_t *test) {
  const int32_t *const expected = test + policy->inputs;
  int32_t command[QJP_COMMANDS];
  uint32_t trace;
  qjp_forward(policy, test, command, &trace);
  uint32_t wrong = trace ^ (uint32_t)expected[QJP_COMMANDS];
  for (uint32_t i = 0U; i < QJP_COMMANDS; ++i) {
    wrong |= (uint32_t)(command[i] ^ expected[i]);
  }
  return (wrong != 0U) ? 1U : 0U;
}

static float float_of(int32_t bits) {
  union {
    float value;
    int32_t bits;
  } pun;
  pun.bits = bits;
  return pun.value;
}

static uint32_t race_test_fails(const qjp_policy *policy, const int32_t *test) {
  const int32_t *const expected = test + policy->state_size + 1U;
  QJP_BUFFER float state[QJP_MAX_STATE];
  QJP_BUFFER int32_t q[QJP_MAX_WIDTH];
  for (uint32_t i = 0U; i < policy->state_size; ++i) {
    state[i] = float_of(test[i]);
  }
  const qjp_status status = qjp_observe(policy, state, (uint32_t)test[policy->state_size], q);
  const int32_t *const flags = expected + policy->inputs;
  uint32_t wrong = status.clipped ^ (uint32_t)flags[0];
  wrong |= (status.nan ^ (uint32_t)flags[1]) | (status.outside ^ (uint32_t)flags[2]);
  for (uint32_t i = 0U; i < policy->inputs; ++i) {
    wrong |= (uint32_t)(q[i] ^ expected[i]);
  }
  return (wrong != 0U) ? 1U : 0U;
}

uint32_t qjp_self_test(const qjp_policy *policy) {
  const int32_t *test = policy->tests;
  uint32_t mismatches = 0U;
  for (uint32_t i = 0U; i < policy->network_tests; ++i) {
    mismatches += network_test_fails(policy, test);
    test += policy->inputs + QJP_COMMANDS + 1U;
  }
  for (uint32_t i = 0U; i < policy->race_tests; ++i) {
    mismatches += race_test_fails(policy, test);
    test += policy->state_size + 1U + policy->inputs + 3U;
  }
  return mismatches;
}

/* ---- the public functions ------------------------------------------------------------------------- */

static qjp_error check_file(qjp_policy *policy, const int32_t *words, uint32_t bytes) {
  const uint32_t count = bytes / 4U;
  if (((bytes & 3U) != 0U) || (count < QJP_HEADER_WORDS + QJP_HASH_WORDS)) {
    return QJP_BAD_SIZE;
  }
  if (words[QJP_AT_MAGIC] != QJP_MAGIC) {
    return QJP_BAD_MAGIC;
  }
  if (words[QJP_AT_VERSION] != QJP_VERSION) {
    return QJP_BAD_VERSION;
  }
  if ((uint32_t)words[QJP_AT_BYTES] != bytes) {
    return QJP_BAD_SIZE;
  }
  if (is_changed(words, count - QJP_HASH_WORDS) != 0U) {
    return QJP_BAD_HASH;
  }
  const qjp_error error = check_counts(words);
  if (error != QJP_OK) {
    return error;
  }
  read_header(policy, words);
  return find_tables(policy, words, count - QJP_HASH_WORDS);
}

qjp_error qjp_load(qjp_policy *policy, const int32_t *words, uint32_t bytes) {
  qjp_error error = check_file(policy, words, bytes);
  if (error == QJP_OK) {
    error = qjp_check(policy);
  }
  if ((error == QJP_OK) && (qjp_self_test(policy) != 0U)) {
    error = QJP_BAD_SELF_TEST;
  }
  return error;
}

const char *qjp_error_name(qjp_error error) {
  static const char *const names[] = {
      "ok",           "bad size",  "not a .qjp file", "other version", "changed: bad hash",
      "too large",    "bad header", "bad state",      "bad observation", "bad track",
      "bad padding",  "range proof fails", "self-test fails"};
  const uint32_t number = (uint32_t)error;
  return (number < sizeof(names) / sizeof(names[0])) ? names[number] : "unknown error";
}

uint32_t qjp_observes(const qjp_policy *policy, qjp_field field) {
  const int32_t *const found = qjp_find(policy, field);
  uint32_t observed = 0U;
  for (uint32_t i = 0U; (found != 0) && (i < policy->parts); ++i) {
    const int32_t *const part = policy->part + QJP_PART_WORDS * i;
    for (int32_t k = 0; (part[0] != QJP_SEE_GATE) && (k < part[2]); ++k) {
      const int32_t *const input = policy->input + QJP_INPUT_WORDS * (part[1] + k);
      const uint32_t zero = ((part[0] == QJP_SEE_SCALED) && (input[2] == 0)) ? 1U : 0U;
      observed |= qjp_within(input[0], found[1], found[1] + found[2] - 1) & ~zero;
    }
  }
  return observed & 1U;
}

uint32_t qjp_is_motor_policy(const qjp_policy *policy) {
  const int32_t one = INT32_C(1) << policy->fraction_bits;
  uint32_t fine = (policy->kind == (uint32_t)QJP_MOTOR) ? 1U : 0U;
  for (uint32_t i = 0U; i < QJP_COMMANDS; ++i) {
    fine &= qjp_within(policy->low[i], 0, one) & qjp_within(policy->high[i], 0, one);
  }
  return fine;
}

void qjp_set(const qjp_policy *policy, float *state, qjp_field field, const float *values) {
  const int32_t *const found = qjp_find(policy, field);
  for (int32_t i = 0; (found != 0) && (i < found[2]); ++i) {
    state[found[1] + i] = values[i];
  }
}
