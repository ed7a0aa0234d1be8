{% import "helpers.c" as c %}
/*
 * ${name}_estimator: see ${name}_estimator.h.
 *
${origin.lines | comment}
 *
 * Measurements are integers of 2^-30 of their ranges, products of two of them are brought back to
 * Q30, and the six channels are kept in fine units of 2^-46 of their ranges. With K / 2^32 the gain
 * of the low-pass, exactly (1 + a1 + a2) / 4, and d what is differentiated times 2 f_s:
 *
 *   y  = K (x + d) + s1
 *   s1 = s2 + 2 K x - a1 y
 *   s2 = K (x - d) - a2 y
 */
#include "${name}_estimator.h"

enum {
  MEASUREMENTS = 13,
  CHANNELS = 6, /* moment x, y, z, force x, y, z */
  Q30 = 30,
  WORD = 32,
  MODEL_BITS = ${bits.model},
  DIFFERENCE_BITS = ${bits.difference},
  LOW_PASS_BITS = ${bits.low_pass},
  FINE_BITS = ${bits.fine},
  SPLIT = 16,
  SELF_TESTS = ${estimator_test.outputs | length},
  TEST_ROWS = ${estimator_test.measurements | length}
};

#define GAIN INT64_C(${estimator.gain}) /* Q32 */
#define A1 INT64_C(${estimator.a1})     /* Q30 */
#define A2 INT64_C(${estimator.a2})     /* Q30 */

static const int8_t exponent[MEASUREMENTS] = {${estimator.exponents | join(", ")}};

/* ---- integers ----------------------------------------------------------------------------------- */

${c.round_shift()}
/* a b in Q30 */
static int64_t product(int64_t a, int64_t b) { return round_shift(a * b, Q30); }

${c.scaled()}
${c.float_of("from_bits")}
${c.bits_of("to_bits")}
static ${name}_status quantize(const ${name}_measurement *m, int32_t q[MEASUREMENTS]) {
  ${name}_status status = {0U, 0U};
  const float x[MEASUREMENTS] = {
      m->gyro[0], m->gyro[1], m->gyro[2], m->specific_force[0], m->specific_force[1],
      m->specific_force[2], m->rpm[0], m->rpm[1], m->rpm[2], m->rpm[3],
      m->velocity[0], m->velocity[1], m->velocity[2]};
${c.quantize_all("q", "MEASUREMENTS", name ~ "_quantize_one(to_bits(x[i]), exponent[i]", 13)}
{% if residuals %}
/* ---- the residual networks ---------------------------------------------------------------------- */

enum {
{% for part, network in residuals.items() %}
{% for layer in network.hidden %}
  ${part | upper}_${loop.index0}_ROWS = ${layer.weights.shape[0]}, ${part | upper}_${loop.index0}_COLUMNS = ${layer.weights.shape[1]},
{% endfor %}
{% endfor %}
  RESIDUAL_INPUTS = 10, /* four propeller speeds, body velocity, body rates */
  RESIDUAL_WIDEST = ${residual_widest}
};
/* What a network adds is held to half of its channel's range. */
#define RESIDUAL_LIMIT INT64_C(${residual_limit})

{% for part, network in residuals.items() %}
{% for layer in network.hidden %}
${table("int32_t", part ~ "_" ~ loop.index0 ~ "_weight", layer.weights)}

${table("int64_t", part ~ "_" ~ loop.index0 ~ "_bias", layer.bias)}

{% endfor %}
${table("int32_t", part ~ "_output_weight", network.output.weights)}

${table("int64_t", part ~ "_output_bias", network.output.bias)}

{% endfor %}
static int64_t row_sum(const int32_t *weight, int64_t bias, const int32_t *x, uint32_t columns) {
  int64_t sum = bias;
  for (uint32_t i = 0U; i < columns; ++i) {
    sum += (int64_t)weight[i] * x[i];
  }
  return sum;
}

${c.relu_upper_word("WORD")}
/* A hidden layer: the upper word of each sum is its output if it is positive. */
static void relu_layer(const int32_t *weight, const int64_t *bias, uint32_t rows, uint32_t columns,
                       const int32_t *x, int32_t *y) {
  for (uint32_t row = 0U; row < rows; ++row) {
    y[row] = relu_upper_word(row_sum(weight, bias[row], x, columns));
    weight += columns;
  }
}

static int64_t held(int64_t value) {
  value = (value > RESIDUAL_LIMIT) ? RESIDUAL_LIMIT : value;
  return (value < -RESIDUAL_LIMIT) ? -RESIDUAL_LIMIT : value;
}

/* Propeller speeds scaled to [-1, 1] over the residual's range. */
static int32_t scaled_rpm(int32_t value) {
  const int64_t rpm = round_shift(((int64_t)value - ${estimator.rpm_input.middle}) * INT64_C(${estimator.rpm_input.factor}), ${estimator.rpm_input.shift});
  const int64_t one = INT64_C(1) << Q30;
  return (int32_t)((rpm > one) ? one : ((rpm < -one) ? -one : rpm));
}

/* Takes what the networks add off the moments and the body-z force. */
static void subtract_residual(const int32_t s[MEASUREMENTS], int64_t x[CHANNELS]) {
  int32_t input[RESIDUAL_INPUTS];
  int32_t a[RESIDUAL_WIDEST];
{% if residual_depth > 1 %}
  int32_t b[RESIDUAL_WIDEST];
{% endif %}
  for (uint32_t i = 0U; i < 4U; ++i) {
    input[i] = scaled_rpm(s[6U + i]);
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    input[4U + i] = s[10U + i];
    input[7U + i] = s[i];
  }
{% for part, network in residuals.items() %}
{% for layer in network.hidden %}
{% set at = part ~ "_" ~ loop.index0 %}
  relu_layer(${at}_weight, ${at}_bias, ${at | upper}_ROWS, ${at | upper}_COLUMNS, ${"input" if loop.first else ("b", "a")[loop.index0 % 2]}, ${("a", "b")[loop.index0 % 2]});
{% endfor %}
{% set source = "input" if not network.hidden else ("b", "a")[network.hidden | length % 2] %}
{% set columns = network.output.weights.shape[1] %}
{% for shift in network.shifts %}
  x[${5 if part == "thrust" else loop.index0}] -= held(round_shift(row_sum(&${part}_output_weight[${loop.index0 * columns}], ${part}_output_bias[${loop.index0}], ${source}, ${columns}U), ${shift}));
{% endfor %}
{% endfor %}
}

{% endif %}
/* ---- the model ---------------------------------------------------------------------------------- */

/* What is not explained: x goes into the filters, d is differentiated by them. */
static void unexplained(const int32_t s[MEASUREMENTS], int64_t x[CHANNELS], int64_t d[3]) {
  const int64_t p = s[0];
  const int64_t q = s[1];
  const int64_t r = s[2];
  const int64_t w1 = s[6];
  const int64_t w2 = s[7];
  const int64_t w3 = s[8];
  const int64_t w4 = s[9];
  const int64_t v_x = s[10];
  const int64_t v_y = s[11];
  const int64_t v_z = s[12];
  const int64_t qr = product(q, r);
  const int64_t rp = product(r, p);
  const int64_t pq = product(p, q);
  const int64_t square_1 = product(w1, w1);
  const int64_t square_2 = product(w2, w2);
  const int64_t square_3 = product(w3, w3);
  const int64_t square_4 = product(w4, w4);
  const int64_t roll_squares = square_1 - square_2 - square_3 + square_4;
  const int64_t pitch_squares = square_1 + square_2 - square_3 - square_4;
  const int64_t sum_squares = square_1 + square_2 + square_3 + square_4;
  const int64_t imbalance = -w1 + w2 - w3 + w4;
  const int64_t sum = w1 + w2 + w3 + w4;
  const int64_t v_x_sum = product(v_x, sum);
  const int64_t v_y_sum = product(v_y, sum);
  const int64_t v_z_sum = product(v_z, sum);
  const int64_t speed_squares = round_shift(v_x * v_x + v_y * v_y, Q30);
{% for name in unused %}
  (void)${name};
{% else %}

{% endfor %}
{% for target, sums, bits in (("x", estimator.model, "MODEL_BITS"), ("d", estimator.differentiated, "DIFFERENCE_BITS")) %}
{% for row in sums %}
  ${target}[${loop.index0}] = round_shift(${terms(row) | join(" +\n                     ") or 0},
                     ${bits});
{% endfor %}
{% endfor %}
{% if residuals %}
  subtract_residual(s, x);
{% else %}

{% endif %}
}

/* ---- the filters -------------------------------------------------------------------------------- */

static void start(${name}_estimator *estimator, const int64_t d[3]) {
  for (uint32_t i = 0U; i < CHANNELS; ++i) {
    estimator->s1[i] = (i < 3U) ? -scaled(d[i], GAIN, LOW_PASS_BITS) : 0;
    estimator->s2[i] = estimator->s1[i];
  }
  estimator->started = 1U;
}

static int64_t filter(${name}_estimator *estimator, uint32_t i, int64_t x, int64_t d) {
  const int64_t y = scaled(x + d, GAIN, LOW_PASS_BITS) + estimator->s1[i];
  estimator->s1[i] = estimator->s2[i] + scaled(2 * x, GAIN, LOW_PASS_BITS) - scaled(y, A1, Q30);
  estimator->s2[i] = scaled(x - d, GAIN, LOW_PASS_BITS) - scaled(y, A2, Q30);
  return y;
}

static ${name}_status update(${name}_estimator *estimator, const ${name}_measurement *measurement,
                            int64_t y[CHANNELS]) {
  int32_t s[MEASUREMENTS];
  int64_t x[CHANNELS];
  int64_t d[3];
  const ${name}_status status = quantize(measurement, s);
  unexplained(s, x, d);
  if (estimator->started == 0U) {
    start(estimator, d);
  }
  for (uint32_t i = 0U; i < CHANNELS; ++i) {
    y[i] = filter(estimator, i, x[i], (i < 3U) ? d[i] : 0);
  }
  return status;
}

/* The unit of 2^-30 of each channel's range: a power of two, so that this is one rounding. */
static const float channel_unit[CHANNELS] = {${(channel_units | wrapped).strip()}};

${name}_estimator_status ${name}_estimator_update(${name}_estimator *estimator,
                                                const ${name}_measurement *measurement,
                                                float moment[3], float force[3]) {
  int64_t y[CHANNELS];
  const ${name}_status status = update(estimator, measurement, y);
  for (uint32_t i = 0U; i < 3U; ++i) {
    moment[i] = (float)(int32_t)(y[i] >> (FINE_BITS - Q30)) * channel_unit[i];
    force[i] = (float)(int32_t)(y[i + 3U] >> (FINE_BITS - Q30)) * channel_unit[i + 3U];
  }
  return status;
}

/* ---- self-test ---------------------------------------------------------------------------------- */

/* The bits of measurements, used again and again. */
static const uint32_t test_measurement[TEST_ROWS][MEASUREMENTS] = {
${rows(estimator_test.measurements, "hex")}
};
/* The channels after each sample, upper words. */
static const int32_t test_output[SELF_TESTS][CHANNELS] = {
${rows(estimator_test.outputs, "int32")}
};

static void load(${name}_measurement *m, const uint32_t bits[MEASUREMENTS]) {
  for (uint32_t i = 0U; i < 3U; ++i) {
    m->gyro[i] = from_bits(bits[i]);
    m->specific_force[i] = from_bits(bits[3U + i]);
    m->velocity[i] = from_bits(bits[10U + i]);
  }
  for (uint32_t i = 0U; i < 4U; ++i) {
    m->rpm[i] = from_bits(bits[6U + i]);
  }
}

uint32_t ${name}_estimator_self_test(void) {
  uint32_t mismatches = 0U;
  ${name}_estimator estimator = {{0}, {0}, 0U};
  for (uint32_t sample = 0U; sample < SELF_TESTS; ++sample) {
    ${name}_measurement measurement;
    int64_t y[CHANNELS];
    uint32_t wrong = 0U;
    load(&measurement, test_measurement[sample % TEST_ROWS]);
    (void)update(&estimator, &measurement, y);
    for (uint32_t i = 0U; i < CHANNELS; ++i) {
      wrong |= (uint32_t)((int32_t)(y[i] >> (FINE_BITS - Q30)) ^ test_output[sample][i]);
    }
    mismatches += (wrong != 0U) ? 1U : 0U;
  }
  return mismatches;
}
