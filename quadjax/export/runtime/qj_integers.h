/* Integer arithmetic that the sources of the runtime share. */
#ifndef QJ_INTEGERS_H
#define QJ_INTEGERS_H

#include "qj.h"
#include "qj_words.h"

enum { Q30 = 30, WORD = 32 };

static inline uint32_t qj_bits(float value) {
  union {
    float value;
    uint32_t bits;
  } pun;
  pun.value = value;
  return pun.bits;
}

static inline float qj_float(int32_t bits) {
  union {
    float value;
    int32_t bits;
  } pun;
  pun.bits = bits;
  return pun.value;
}

/* The bits of one float of range +-2^exponent to an integer of which the range is +-2^30, truncated.
 * exponent is -96 to 96. Total: NaN is zero, and what is outside the range is its edge. By the bits,
 * so that no compiler flag, rounding mode or missing FPU matters. */
static inline int32_t qj_quantize_one(uint32_t bits, int32_t exponent, uint32_t *clipped,
                                      uint32_t *nan) {
  const uint32_t limit = (uint32_t)(127 + exponent) << 23;
  uint32_t magnitude = bits & UINT32_C(0x7FFFFFFF);
  *nan = (magnitude > UINT32_C(0x7F800000)) ? 1U : 0U;
  *clipped = ((magnitude > limit) ? 1U : 0U) & ~*nan;
  magnitude = (magnitude > limit) ? limit : magnitude;
  const uint32_t significand = (magnitude & UINT32_C(0x007FFFFF)) | UINT32_C(0x00800000);
  /* significand 2^(field - 150) 2^30 / 2^exponent is a shift, at most 7 to the left. One to the
   * right by more than 24 gives zero, subnormal numbers included: 31 stands for all of those. */
  const int32_t shift = (int32_t)(magnitude >> 23) - 120 - exponent;
  const uint32_t negative = 0U - ((uint32_t)shift >> 31);
  const uint32_t left = (uint32_t)shift & ~negative & 7U;
  uint32_t right = (0U - (uint32_t)shift) & negative;
  right = (right > 31U) ? 31U : right;
  uint32_t value = (significand << left) >> right;
  value = (value > (UINT32_C(1) << 30)) ? (UINT32_C(1) << 30) : value; /* it is not: a guard */
  /* Factors of 1, -1 and 0 rather than branches: the time is the same for all data. */
  const int32_t sign = 1 - (int32_t)((bits >> 31) << 1);
  return (int32_t)value * sign * (int32_t)(1U - *nan);
}

static inline void qj_flag(uint32_t *mask, uint32_t i, uint32_t set) {
  *mask |= set << ((i < 31U) ? i : 31U);
}

/* Floats as integers of their ranges. */
static inline qj_status qj_quantize_all(const float *x, const int32_t *exponents, uint32_t count,
                                        int32_t *q) {
  qj_status status = {0U, 0U, 0U};
  for (uint32_t i = 0U; i < count; ++i) {
    uint32_t clipped;
    uint32_t nan;
    q[i] = qj_quantize_one(qj_bits(x[i]), exponents[i], &clipped, &nan);
    qj_flag(&status.clipped, i, clipped);
    qj_flag(&status.nan, i, nan);
  }
  return status;
}

/* value / 2^shift to the nearest, halves up; shift is 1 to 62. */
static inline int64_t qj_round_shift(int64_t value, int32_t shift) {
  return (value + (INT64_C(1) << (shift - 1))) >> shift;
}

/* value * factor / 2^bits of a product that needs more than 64 bits, in two parts. */
static inline int64_t qj_scaled(int64_t value, int64_t factor, int32_t bits) {
  const int64_t lower = value & 0xFFFF;
  return qj_round_shift((value >> 16) * factor + ((lower * factor) >> 16), bits - 16);
}

static inline int64_t qj_clamp(int64_t value, int64_t low, int64_t high) {
  value = (value > high) ? high : value;
  return (value < low) ? low : value;
}

/* A number of two words, the low one first. */
static inline int64_t qj_long(const int32_t *words) {
  return words[1] * (INT64_C(1) << 32) + (int64_t)(uint32_t)words[0];
}

static inline uint32_t qj_within(int64_t value, int64_t low, int64_t high) {
  return ((value >= low) && (value <= high)) ? 1U : 0U;
}

/* FNV-1a over 32-bit words. */
#define QJ_DIGEST_START UINT32_C(2166136261)
static inline uint32_t qj_digest(uint32_t digest, uint32_t word) {
  return (digest ^ word) * UINT32_C(16777619);
}

static inline uint32_t qj_digest_long(uint32_t digest, int64_t value) {
  const uint64_t bits = (uint64_t)value;
  return qj_digest(qj_digest(digest, (uint32_t)bits), (uint32_t)(bits >> 32));
}

/* Sums of the last of ``count`` layers, of inputs in the first buffer, padded with zeros. */
void qj_run_layers(const qj_policy *policy, const qj_layer *layer, uint32_t count,
                   int32_t buffer[2][QJ_MAX_WIDTH], int64_t sums[QJ_COMMANDS], uint32_t *trace);

/* The words of the field of the state with a code, or 0. */
const int32_t *qj_find_field(const qj_policy *policy, int32_t code);

#ifdef QJ_SAMPLED
/* Of the noise of the first samples, for the self-test. */
uint32_t qj_noise_digest(const int32_t *noise);
#endif

/* Checks of the contents, once the sizes and the checksum are right: qj_check.c. */
qj_error qj_check(const qj_policy *policy);

/* The first of the residual's layers of the moment, which follow those of the thrust. */
static inline uint32_t qj_moment_layer(const qj_policy *policy) {
  return policy->layers + (uint32_t)policy->estimator[QJ_ESTIMATOR_THRUST_LAYERS];
}

#endif /* QJ_INTEGERS_H */
