/* Loading: sizes, the checksum and the self-tests; see qj.h. Nothing after the header is used before
 * the checksum is right, and no number of it before the checks of qj_check.c. */
#include "qj_integers.h"

#ifdef QJ_SAMPLED
#define LAST_VERSION QJ_SAMPLED_VERSION
#else
#define LAST_VERSION QJ_VERSION
#endif
enum { MAX_COUNT = 4096 }; /* of gates, terms and self-tests: so that no size overflows */

/* Words that are taken one part after the other. */
typedef struct {
  const int32_t *at;
  uint32_t left;
  uint32_t error; /* there were fewer */
} cursor;

static const int32_t *take(cursor *words, uint32_t count) {
  const int32_t *const part = words->at;
  const uint32_t taken = (count <= words->left) ? count : 0U;
  words->error |= (taken != count) ? 1U : 0U;
  words->at += taken;
  words->left -= taken;
  return part;
}

/* CRC-32 of IEEE 802.3, reflected, as zlib computes it; four bits at a time. */
static uint32_t crc32_of(const int32_t *words, uint32_t count) {
  uint32_t table[16];
  uint32_t crc = 0xFFFFFFFFU;
  for (uint32_t i = 0U; i < 16U; ++i) {
    table[i] = i;
    for (uint32_t bit = 0U; bit < 4U; ++bit) {
      table[i] = (table[i] >> 1) ^ (UINT32_C(0xEDB88320) & (0U - (table[i] & 1U)));
    }
  }
  for (uint32_t i = 0U; i < count; ++i) {
    crc ^= (uint32_t)words[i];
    for (uint32_t nibble = 0U; nibble < 8U; ++nibble) {
      crc = (crc >> 4) ^ table[crc & 15U];
    }
  }
  return ~crc;
}

static qj_error check_counts(const int32_t *w) {
  const uint32_t small = qj_within(w[QJ_HEADER_LAYERS], 1, QJ_MAX_LAYERS) &
                         qj_within(w[QJ_HEADER_INPUTS], 1, QJ_MAX_WIDTH) &
                         qj_within(w[QJ_HEADER_STATE_SIZE], 1, QJ_MAX_STATE);
  const uint32_t allowed = qj_within(w[QJ_HEADER_FIELDS], 1, QJ_HIGHEST_RPM) &
                           qj_within(w[QJ_HEADER_PARTS], 1, w[QJ_HEADER_INPUTS]) &
                           qj_within(w[QJ_HEADER_GATES], 1, MAX_COUNT) &
                           qj_within(w[QJ_HEADER_CONSTANTS], 0, w[QJ_HEADER_INPUTS]) &
                           qj_within(w[QJ_HEADER_NETWORK_TESTS], 1, MAX_COUNT) &
                           qj_within(w[QJ_HEADER_RACE_TESTS], 1, MAX_COUNT) &
                           qj_within(w[QJ_HEADER_ESTIMATOR], 0, 1) &
                           qj_within(w[QJ_HEADER_BATTERY], 0, 1);
  if (allowed == 0U) {
    return QJ_BAD_HEADER;
  }
  return (small == 0U) ? QJ_TOO_LARGE : QJ_OK;
}

/* To a power of two. */
static uint32_t padded(uint32_t count, uint32_t multiple) {
  return (count + multiple - 1U) & ~(multiple - 1U);
}

/* The tables of a network of ``count`` layers, of which the sizes are stated. */
static qj_error find_layers(qj_layer *layer, uint32_t count, const int32_t *sizes,
                            uint32_t columns, uint32_t outputs, cursor *words) {
  for (uint32_t i = 0U; i < count; ++i) {
    const int32_t *const size = sizes + QJ_LAYER_WORDS * i;
    if ((qj_within(size[QJ_LAYER_ROWS], 1, QJ_MAX_WIDTH) == 0U) ||
        (size[QJ_LAYER_COLUMNS] != (int32_t)columns)) {
      return (size[QJ_LAYER_ROWS] > QJ_MAX_WIDTH) ? QJ_TOO_LARGE : QJ_BAD_HEADER;
    }
    layer[i].rows = (uint32_t)size[QJ_LAYER_ROWS];
    layer[i].columns = columns;
    layer[i].padded_rows = padded(layer[i].rows, (i + 1U < count) ? 8U : 4U);
    layer[i].padded_columns = padded(columns, 8U);
    if ((layer[i].padded_rows > QJ_MAX_WIDTH) || (layer[i].padded_columns > QJ_MAX_WIDTH)) {
      return QJ_TOO_LARGE;
    }
    layer[i].weights = take(words, layer[i].padded_rows * layer[i].padded_columns);
    layer[i].bias = take(words, 2U * layer[i].padded_rows);
    columns = layer[i].rows;
  }
  return (columns == outputs) ? QJ_OK : QJ_BAD_HEADER;
}

static qj_error find_estimator(qj_policy *policy, cursor *words) {
  const int32_t *const e = take(words, QJ_ESTIMATOR_WORDS);
  if (words->error != 0U) {
    return QJ_BAD_SIZE;
  }
  policy->estimator = e;
  const int32_t thrust = e[QJ_ESTIMATOR_THRUST_LAYERS];
  const int32_t moment = e[QJ_ESTIMATOR_MOMENT_LAYERS];
  if ((qj_within(e[QJ_ESTIMATOR_TERMS], 0, MAX_COUNT) &
       qj_within(thrust, 0, QJ_MAX_LAYERS) & qj_within(moment, 0, QJ_MAX_LAYERS)) == 0U) {
    return QJ_BAD_ESTIMATOR;
  }
  if ((thrust == 0) != (moment == 0)) {
    return QJ_BAD_ESTIMATOR;
  }
  if (policy->layers + (uint32_t)(thrust + moment) > QJ_MAX_LAYERS) {
    return QJ_TOO_LARGE;
  }
  policy->terms = take(words, QJ_TERM_WORDS * (uint32_t)e[QJ_ESTIMATOR_TERMS]);
  const int32_t *const sizes = take(words, QJ_LAYER_WORDS * (uint32_t)(thrust + moment));
  if ((words->error != 0U) || (thrust == 0)) {
    return (words->error != 0U) ? QJ_BAD_SIZE : QJ_OK;
  }
  qj_layer *const layer = policy->layer + policy->layers;
  const qj_error error = find_layers(layer, (uint32_t)thrust, sizes, 7U, 1U, words);
  return (error != QJ_OK) ? error
                          : find_layers(layer + thrust, (uint32_t)moment,
                                        sizes + QJ_LAYER_WORDS * (uint32_t)thrust, 10U, 3U, words);
}

static void read_header(qj_policy *policy, const int32_t *w) {
  policy->words = w;
  policy->kernel = QJ_DEFAULT_KERNEL;
  policy->inputs = (uint32_t)w[QJ_HEADER_INPUTS];
  policy->layers = (uint32_t)w[QJ_HEADER_LAYERS];
  policy->state_size = (uint32_t)w[QJ_HEADER_STATE_SIZE];
  policy->fields = (uint32_t)w[QJ_HEADER_FIELDS];
  policy->parts = (uint32_t)w[QJ_HEADER_PARTS];
  policy->gates = (uint32_t)w[QJ_HEADER_GATES];
  policy->gate_words = QJ_GATE_WORDS + (uint32_t)w[QJ_HEADER_CONSTANTS];
  policy->world_box = (uint32_t)w[QJ_HEADER_WORLD_BOX];
  policy->kind = (w[QJ_HEADER_KIND] == QJ_RPM)     ? QJ_RPM
                 : (w[QJ_HEADER_KIND] == QJ_MOTOR) ? QJ_MOTOR
                                                   : QJ_RATES_THRUST;
  policy->output_shift = (uint32_t)w[QJ_HEADER_OUTPUT_SHIFT];
  policy->fraction_bits = (uint32_t)w[QJ_HEADER_FRACTION_BITS];
  policy->period_ns = (uint32_t)w[QJ_HEADER_PERIOD_NS];
  policy->position = 0U;
  policy->low = w + QJ_HEADER_LOW;
  policy->high = w + QJ_HEADER_HIGH;
  policy->estimator = 0;
  policy->terms = 0;
  policy->battery = 0;
}

/* Where everything is. */
static qj_error find_tables(qj_policy *policy, const int32_t *w, uint32_t count) {
  cursor words = {w + QJ_HEADER_WORDS, count - QJ_HEADER_WORDS, 0U};
  const int32_t *const sizes = take(&words, QJ_LAYER_WORDS * policy->layers);
  policy->field = take(&words, QJ_FIELD_WORDS * policy->fields);
  policy->exponents = take(&words, policy->state_size);
  policy->part = take(&words, QJ_PART_WORDS * policy->parts);
  policy->input = take(&words, QJ_INPUT_WORDS * policy->inputs);
  policy->gate = take(&words, policy->gate_words * policy->gates);
  if (words.error != 0U) {
    return QJ_BAD_SIZE;
  }
  qj_error error =
      find_layers(policy->layer, policy->layers, sizes, policy->inputs, QJ_COMMANDS, &words);
  if ((error == QJ_OK) && (w[QJ_HEADER_ESTIMATOR] != 0)) {
    error = find_estimator(policy, &words);
  }
  if (w[QJ_HEADER_BATTERY] != 0) {
    policy->battery = take(&words, QJ_BATTERY_WORDS);
  }
#ifdef QJ_SAMPLED
  policy->noise =
      (w[QJ_HEADER_VERSION] == QJ_SAMPLED_VERSION) ? take(&words, QJ_NOISE_WORDS) : 0;
#endif
  policy->tests = words.at;
  (void)take(&words, (uint32_t)w[QJ_HEADER_NETWORK_TESTS] * (policy->inputs + QJ_COMMANDS + 1U));
  (void)take(&words, (uint32_t)w[QJ_HEADER_RACE_TESTS] *
                         (policy->state_size + 1U + policy->inputs + 3U));
  (void)take(&words, (w[QJ_HEADER_ESTIMATOR] != 0) ? QJ_TEST_ROWS * 13U + QJ_TEST_SAMPLES * 6U : 0U);
  (void)take(&words, (w[QJ_HEADER_BATTERY] != 0) ? QJ_TEST_ROWS * 8U + QJ_TEST_SAMPLES : 0U);
  if (error != QJ_OK) {
    return error;
  }
  return ((words.error == 0U) && (words.left == 0U)) ? QJ_OK : QJ_BAD_SIZE;
}

/* ---- self-tests --------------------------------------------------------------------------------- */

static uint32_t network_test_fails(const qj_policy *policy, const int32_t *test) {
  const int32_t *const expected = test + policy->inputs;
  int32_t command[QJ_COMMANDS];
  uint32_t trace;
  qj_forward(policy, test, command, &trace);
  uint32_t wrong = trace ^ (uint32_t)expected[QJ_COMMANDS];
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    wrong |= (uint32_t)(command[i] ^ expected[i]);
  }
  return (wrong != 0U) ? 1U : 0U;
}

static uint32_t race_test_fails(const qj_policy *policy, const int32_t *test) {
  float state[QJ_MAX_STATE];
  int32_t q[QJ_MAX_WIDTH];
  const int32_t *const expected = test + policy->state_size + 1U;
  const int32_t *const flags = expected + policy->inputs;
  for (uint32_t i = 0U; i < policy->state_size; ++i) {
    state[i] = qj_float(test[i]);
  }
  const qj_status status = qj_observe(policy, (uint32_t)test[policy->state_size], state, q);
  uint32_t wrong = (status.clipped ^ (uint32_t)flags[0]) | (status.nan ^ (uint32_t)flags[1]) |
                   (status.outside ^ (uint32_t)flags[2]);
  for (uint32_t i = 0U; i < policy->inputs; ++i) {
    wrong |= (uint32_t)(q[i] ^ expected[i]);
  }
  return (wrong != 0U) ? 1U : 0U;
}

static void read_sample(const int32_t *bits, uint32_t count, float *sample) {
  for (uint32_t i = 0U; i < count; ++i) {
    sample[i] = qj_float(bits[i]);
  }
}

static uint32_t estimator_test_fails(const qj_policy *policy, const int32_t *tests) {
  const int32_t *expected = tests + QJ_TEST_ROWS * 13U;
  qj_estimator estimator = {{0}, {0}, 0U};
  uint32_t wrong = 0U;
  for (uint32_t number = 0U; number < QJ_TEST_SAMPLES; ++number) {
    float sample[13];
    float y[6];
    read_sample(tests + (number % QJ_TEST_ROWS) * 13U, 13U, sample);
    (void)qj_estimator_update(policy, &estimator, sample, y, y + 3);
    for (uint32_t i = 0U; i < 6U; ++i) {
      wrong |= qj_bits(y[i]) ^ (uint32_t)*expected++;
    }
  }
  return (wrong != 0U) ? 1U : 0U;
}

/* A digest of the memory after each sample; the estimate goes to both of its limits in turn. */
static uint32_t battery_test_fails(const qj_policy *policy, const int32_t *tests) {
  const int32_t *const expected = tests + QJ_TEST_ROWS * 8U;
  qj_battery battery = {{0}, {0}, {0}, 0, 0U};
  uint32_t wrong = 0U;
  for (uint32_t number = 0U; number < QJ_TEST_SAMPLES; ++number) {
    float sample[8];
    float highest;
    uint32_t digest = QJ_DIGEST_START;
    read_sample(tests + (number % QJ_TEST_ROWS) * 8U, 8U, sample);
    if ((number != 0U) && ((number % (QJ_TEST_ROWS / 2U)) == 0U)) {
      battery.highest = qj_long(policy->battery + (((number % QJ_TEST_ROWS) == 0U)
                                                       ? QJ_BATTERY_LOWEST
                                                       : QJ_BATTERY_HIGHEST));
    }
    (void)qj_battery_update(policy, &battery, sample, &highest);
    const int64_t *const memory[] = {battery.speed, battery.expected, battery.limited};
    for (uint32_t i = 0U; i < 12U; ++i) {
      digest = qj_digest_long(digest, memory[i / 4U][i % 4U]);
    }
    wrong |= qj_digest_long(digest, battery.highest) ^ (uint32_t)expected[number];
  }
  return (wrong != 0U) ? 1U : 0U;
}

uint32_t qj_self_test(const qj_policy *policy) {
  const int32_t *const w = policy->words;
  const int32_t *test = policy->tests;
  uint32_t mismatches = 0U;
  for (int32_t i = 0; i < w[QJ_HEADER_NETWORK_TESTS]; ++i) {
    mismatches += network_test_fails(policy, test);
    test += policy->inputs + QJ_COMMANDS + 1U;
  }
  for (int32_t i = 0; i < w[QJ_HEADER_RACE_TESTS]; ++i) {
    mismatches += race_test_fails(policy, test);
    test += policy->state_size + 4U + policy->inputs;
  }
  if (policy->estimator != 0) {
    mismatches += estimator_test_fails(policy, test);
    test += QJ_TEST_ROWS * 13U + QJ_TEST_SAMPLES * 6U;
  }
#ifdef QJ_SAMPLED
  if (policy->noise != 0) {
    mismatches +=
        (qj_noise_digest(policy->noise) != (uint32_t)policy->noise[QJ_NOISE_DIGEST]) ? 1U : 0U;
  }
#endif
  return mismatches + ((policy->battery != 0) ? battery_test_fails(policy, test) : 0U);
}

/* ---- the public functions ------------------------------------------------------------------------- */

static qj_error check_words(const int32_t *w, uint32_t bytes) {
  const uint32_t count = bytes / 4U;
  if (((bytes & 3U) != 0U) || (count < QJ_HEADER_WORDS + 1U)) {
    return QJ_BAD_SIZE;
  }
  if (w[QJ_HEADER_MAGIC] != QJ_MAGIC) {
    return QJ_BAD_MAGIC;
  }
  if ((w[QJ_HEADER_VERSION] != QJ_VERSION) && (w[QJ_HEADER_VERSION] != LAST_VERSION)) {
    return QJ_BAD_VERSION;
  }
  if ((uint32_t)w[QJ_HEADER_BYTES] != bytes) {
    return QJ_BAD_SIZE;
  }
  if (crc32_of(w, count - 1U) != (uint32_t)w[count - 1U]) {
    return QJ_BAD_CHECKSUM;
  }
  return check_counts(w);
}

qj_error qj_load(qj_policy *policy, const int32_t *words, uint32_t bytes) {
  qj_error error = check_words(words, bytes);
  if (error == QJ_OK) {
    read_header(policy, words);
    error = find_tables(policy, words, bytes / 4U - 1U);
  }
  if (error == QJ_OK) {
    error = qj_check(policy);
  }
  if (error == QJ_OK) {
    for (uint32_t i = 0U; i < policy->fields; ++i) {
      const int32_t *const field = policy->field + QJ_FIELD_WORDS * i;
      policy->position = (field[QJ_FIELD_CODE] == QJ_POSITION) ? (uint32_t)field[QJ_FIELD_START]
                                                               : policy->position;
    }
  }
  if ((error == QJ_OK) && (qj_self_test(policy) != 0U)) {
    error = QJ_BAD_SELF_TEST;
  }
  return error;
}

const char *qj_error_name(qj_error error) {
  static const char *const names[] = {
      "ok",            "bad size",  "not a policy", "other version",   "changed: bad checksum",
      "too large",     "bad header", "bad state",   "bad observation", "bad track",
      "bad padding",   "range proof fails",         "bad estimator",   "self-test fails"};
  const uint32_t number = (uint32_t)error;
  return (number < sizeof(names) / sizeof(names[0])) ? names[number] : "unknown error";
}
