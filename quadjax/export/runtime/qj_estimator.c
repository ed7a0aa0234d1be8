/*
 * Estimators of external moment and force, and of the highest rpm: see qj.h.
 *
 * Disturbances: measurements are integers of 2^-30 of their ranges, products of two of them are
 * brought back to Q30, and the six channels are kept in fine units of 2^-46 of their ranges. With
 * K / 2^32 the gain of the low-pass and d what is differentiated times 2 f_s:
 *
 *   y = K (x + d) + s1,  s1 = s2 + 2 K x - a1 y,  s2 = K (x - d) - a2 y
 *
 * Highest rpm: speeds and commands are integers of 2^-30 of their range, the memory is in fine units
 * of 2^-40 of it. With w a measured speed, u its command and h the estimate, for each motor:
 *
 *   expected' = expected + k (min(u, h) - expected)
 *   limited'  = limited + k ([u >= h] - limited)
 *   error     = speed + lead (w - speed) - expected'
 *   speed'    = speed + k (w - speed)
 *
 * and h' = h + gain sum(error limited'), held to its limits.
 */
#include "qj_integers.h"

enum { LOW_PASS_BITS = 32, MODEL_BITS = 14, DIFFERENCE_BITS = 10 };

/* a b in Q30 */
static int64_t product(int64_t a, int64_t b) { return qj_round_shift(a * b, Q30); }

static void monomials(const int32_t s[13], int64_t m[QJ_MONOMIALS]) {
  int64_t square[4];
  const int64_t sum = (int64_t)s[6] + s[7] + s[8] + s[9];
  for (uint32_t i = 0U; i < 4U; ++i) {
    square[i] = product(s[6U + i], s[6U + i]);
  }
  for (uint32_t i = 0U; i < 6U; ++i) {
    m[i] = s[i]; /* rates and specific force */
  }
  m[6] = s[10];
  m[7] = s[11];
  m[8] = product(s[1], s[2]);
  m[9] = product(s[2], s[0]);
  m[10] = product(s[0], s[1]);
  m[11] = square[0] - square[1] - square[2] + square[3];
  m[12] = square[0] + square[1] - square[2] - square[3];
  m[13] = square[0] + square[1] + square[2] + square[3];
  m[14] = -(int64_t)s[6] + s[7] - s[8] + s[9];
  for (uint32_t i = 0U; i < 3U; ++i) {
    m[15U + i] = product(s[10U + i], sum);
  }
  m[18] = qj_round_shift((int64_t)s[10] * s[10] + (int64_t)s[11] * s[11], Q30);
}

/* What the residual networks add, held to half of the channels' ranges. */
static void residual(const qj_policy *policy, const int32_t s[13], uint32_t first, uint32_t count,
                     const int32_t *shifts, uint32_t outputs, int64_t *x) {
  int32_t buffer[2][QJ_MAX_WIDTH];
  const int32_t *const e = policy->estimator;
  const qj_layer *const layer = &policy->layer[first];
  int64_t sums[QJ_COMMANDS];
  for (uint32_t i = 0U; i < layer->padded_columns; ++i) {
    buffer[0][i] = 0;
  }
  for (uint32_t i = 0U; i < 4U; ++i) {
    const int64_t apart = (int64_t)s[6U + i] - e[QJ_ESTIMATOR_RPM_MIDDLE];
    const int64_t rpm = qj_round_shift(apart * e[QJ_ESTIMATOR_RPM_FACTOR],
                                       e[QJ_ESTIMATOR_RPM_SHIFT]);
    buffer[0][i] = (int32_t)qj_clamp(rpm, -QJ_INPUT_ONE, QJ_INPUT_ONE);
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    buffer[0][4U + i] = s[10U + i];
    buffer[0][7U + i] = (layer->columns > 7U) ? s[i] : 0;
  }
  qj_run_layers(policy, layer, count, buffer, sums, 0);
  for (uint32_t i = 0U; i < outputs; ++i) {
    x[i] -= qj_clamp(qj_round_shift(sums[i], shifts[i]), -(INT64_C(1) << (QJ_FINE_BITS - 1)),
                     INT64_C(1) << (QJ_FINE_BITS - 1));
  }
}

/* What is not explained: x goes into the filters, d is differentiated by them. */
static void unexplained(const qj_policy *policy, const int32_t s[13], int64_t x[QJ_CHANNELS],
                        int64_t d[QJ_CHANNELS]) {
  const int32_t *const e = policy->estimator;
  const int32_t *term = policy->terms;
  int64_t sums[2 * QJ_CHANNELS] = {0};
  int64_t m[QJ_MONOMIALS];
  monomials(s, m);
  for (int32_t i = 0; i < e[QJ_ESTIMATOR_TERMS]; ++i) {
    sums[term[QJ_TERM_CHANNEL]] += qj_long(term + QJ_TERM_FACTOR) * m[term[QJ_TERM_MONOMIAL]];
    term += QJ_TERM_WORDS;
  }
  for (uint32_t i = 0U; i < QJ_CHANNELS; ++i) {
    x[i] = qj_round_shift(sums[i], MODEL_BITS);
    d[i] = qj_round_shift(sums[QJ_CHANNELS + i], DIFFERENCE_BITS);
  }
  if (e[QJ_ESTIMATOR_THRUST_LAYERS] != 0) {
    residual(policy, s, policy->layers, (uint32_t)e[QJ_ESTIMATOR_THRUST_LAYERS],
             e + QJ_ESTIMATOR_THRUST_SHIFT, 1U, x + 5);
    residual(policy, s, qj_moment_layer(policy), (uint32_t)e[QJ_ESTIMATOR_MOMENT_LAYERS],
             e + QJ_ESTIMATOR_MOMENT_SHIFT, 3U, x);
  }
}

/* The converter has bounded the output by the range; the clamp, which changes nothing then, makes
 * that hold for any numbers. */
static int64_t filter(const int32_t *e, qj_estimator *estimator, uint32_t i, int64_t x, int64_t d) {
  const int64_t gain = qj_long(e + QJ_ESTIMATOR_GAIN);
  const int64_t limit = INT64_C(1) << QJ_FINE_BITS;
  const int64_t y = qj_clamp(qj_scaled(x + d, gain, LOW_PASS_BITS) + estimator->s1[i], -limit, limit);
  estimator->s1[i] = estimator->s2[i] + qj_scaled(2 * x, gain, LOW_PASS_BITS) -
                     qj_scaled(y, qj_long(e + QJ_ESTIMATOR_A1), Q30);
  estimator->s2[i] = qj_scaled(x - d, gain, LOW_PASS_BITS) -
                     qj_scaled(y, qj_long(e + QJ_ESTIMATOR_A2), Q30);
  return y;
}

/* A power of two, so that a product with it is exact. */
static float power_of_two(int32_t exponent) { return qj_float((127 + exponent) * (1 << 23)); }

qj_status qj_estimator_update(const qj_policy *policy, qj_estimator *estimator,
                              const float measured[13], float moment[3], float force[3]) {
  const int32_t *const e = policy->estimator;
  int32_t s[13];
  int64_t x[QJ_CHANNELS];
  int64_t d[QJ_CHANNELS];
  float y[QJ_CHANNELS];
  const qj_status status = qj_quantize_all(measured, e + QJ_ESTIMATOR_EXPONENTS, 13U, s);
  unexplained(policy, s, x, d);
  for (uint32_t i = 0U; i < QJ_CHANNELS; ++i) {
    if (estimator->started == 0U) {
      estimator->s1[i] = -qj_scaled(d[i], qj_long(e + QJ_ESTIMATOR_GAIN), LOW_PASS_BITS);
      estimator->s2[i] = estimator->s1[i];
    }
    const int64_t fine = filter(e, estimator, i, x[i], d[i]);
    y[i] = (float)(int32_t)(fine >> (QJ_FINE_BITS - Q30)) *
           power_of_two(e[QJ_ESTIMATOR_CHANNELS + i] - Q30);
  }
  estimator->started = 1U;
  for (uint32_t i = 0U; i < 3U; ++i) {
    moment[i] = y[i];
    force[i] = y[3U + i];
  }
  return status;
}

/* ---- the highest rpm ---------------------------------------------------------------------------- */

#define FINE (INT64_C(1) << (QJ_BATTERY_BITS - Q30)) /* fine units of 2^-30 of the range */
#define ONE (INT64_C(1) << QJ_BATTERY_BITS)          /* of limited */

static int64_t towards(const int32_t *b, int64_t past, int64_t now) {
  return past + qj_scaled(now - past, b[QJ_BATTERY_LOW_PASS], b[QJ_BATTERY_LOW_PASS_SHIFT]);
}

static void advance(const int32_t *b, qj_battery *battery, const int32_t s[8]) {
  const int64_t limit = battery->highest;
  int64_t sum = 0;
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    const int64_t rpm = s[i] * FINE;
    const int64_t command = s[QJ_COMMANDS + i] * FINE;
    const int64_t speed = battery->speed[i];
    battery->expected[i] = towards(b, battery->expected[i], (command >= limit) ? limit : command);
    battery->limited[i] = towards(b, battery->limited[i], (command >= limit) ? ONE : 0);
    const int64_t error =
        speed + qj_scaled(rpm - speed, b[QJ_BATTERY_LEAD], b[QJ_BATTERY_LEAD_SHIFT]) -
        battery->expected[i];
    battery->speed[i] = towards(b, speed, rpm);
    sum += qj_scaled(error, battery->limited[i] >> (QJ_BATTERY_BITS - Q30), Q30);
  }
  battery->highest =
      qj_clamp(limit + qj_scaled(sum, b[QJ_BATTERY_GAIN], b[QJ_BATTERY_GAIN_SHIFT]),
               qj_long(b + QJ_BATTERY_LOWEST), qj_long(b + QJ_BATTERY_HIGHEST));
}

qj_status qj_battery_update(const qj_policy *policy, qj_battery *battery, const float sample[8],
                            float *highest_rpm) {
  const int32_t *const b = policy->battery;
  int32_t exponents[8];
  int32_t s[8];
  for (uint32_t i = 0U; i < 8U; ++i) {
    exponents[i] = b[QJ_BATTERY_EXPONENT];
  }
  const qj_status status = qj_quantize_all(sample, exponents, 8U, s);
  if (battery->started != 0U) {
    advance(b, battery, s);
  } else {
    for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
      battery->speed[i] = s[i] * FINE;
      battery->expected[i] = s[i] * FINE;
      battery->limited[i] = 0;
    }
    battery->highest = qj_long(b + QJ_BATTERY_FIRST);
    battery->started = 1U;
  }
  *highest_rpm = (float)(int32_t)(battery->highest >> (QJ_BATTERY_BITS - Q30)) *
                 power_of_two(b[QJ_BATTERY_EXPONENT] - Q30);
  return status;
}
