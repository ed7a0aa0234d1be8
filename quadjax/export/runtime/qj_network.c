/*
 * The network: see qj.h.
 *
 * Every hidden neuron is  y = max(0, (bias + sum of weight * x) >> 32),  the rounding half folded
 * into its bias: ReLU, rounding and requantization are one shift by a whole word. qj_load proves that
 * no partial sum reaches 2^63 and no y exceeds 2^30 - 1. Right shifts of negative numbers are
 * arithmetic, as in every compiler that this is for; the self-test would see it otherwise.
 */
#include "qj_integers.h"

#if QJ_HAS_NEON
#if !defined(__ARM_NEON) && !defined(__ARM_NEON__)
/* Only what lies between push and pop is compiled for NEON: the rest must run without it. */
#pragma GCC push_options
#pragma GCC target("fpu=neon")
#include <arm_neon.h>
#pragma GCC pop_options
#define NEON_NEEDS_TARGET 1
#else
#include <arm_neon.h>
#define NEON_NEEDS_TARGET 0
#endif
#endif

/* Tables are in blocks of four rows; within a block, the four weights of column 0, of column 1 .. */
enum { ROWS_PER_BLOCK = 4, COLUMNS_PER_TURN = 8 };

/* The kernels stay functions of their own: they need all registers, and clang with NEON would take
 * their sums and what follows for vectors and emulate products of 64 bits. */
#if defined(__GNUC__)
#define KERNEL __attribute__((noinline)) static
#else
#define KERNEL static inline
#endif

/* Two rows at a time: their sums, their weights and the input are what the registers of a 32-bit ARM
 * hold without spilling. QJ_PORTABLE leaves the assembly out. */
#if defined(__arm__) && defined(__GNUC__) && defined(__ARM_ARCH) && !defined(QJ_PORTABLE)
#if (__ARM_ARCH >= 7) && (defined(__ARM_ARCH_ISA_ARM) || (__ARM_ARCH_ISA_THUMB >= 2))
#define HAS_SMLAL 1
#endif
#endif

#ifdef HAS_SMLAL
/* Every ARMv7 has LDRD and SMLAL, Cortex-M included; compilers use the first one rarely. Two
 * columns: weights at offset a and b, inputs in r8 and r9. */
#define TWO_COLUMNS(first, second) \
  "ldrd r8, r9, [%[x]], #8\n\t" first "ldrd r4, r5, [%[w], #" second "]\n\t" \
  "smlal %Q[a], %R[a], r2, r8\n\tsmlal %Q[b], %R[b], r3, r8\n\t" \
  "smlal %Q[a], %R[a], r4, r9\n\tsmlal %Q[b], %R[b], r5, r9\n\t"
#define WEIGHTS(offset) "ldrd r2, r3, [%[w], #" offset "]\n\t"

static inline void sums_of_two(const int32_t *weight, const int32_t *bias, const int32_t *x,
                               uint32_t columns, int64_t sums[2]) {
  int64_t sum_0 = qj_long(bias);
  int64_t sum_1 = qj_long(bias + 2);
  const int32_t *const end = x + columns;
  __asm__("1:\n\t" TWO_COLUMNS("ldrd r2, r3, [%[w]], #128\n\t", "-112")
          TWO_COLUMNS(WEIGHTS("-96"), "-80")
          TWO_COLUMNS(WEIGHTS("-64"), "-48")
          TWO_COLUMNS(WEIGHTS("-32"), "-16")
          "cmp %[x], %[end]\n\tbne 1b"
          : [a] "+r"(sum_0), [b] "+r"(sum_1), [w] "+r"(weight), [x] "+r"(x)
          : [end] "r"(end)
          : "r2", "r3", "r4", "r5", "r8", "r9", "cc", "memory");
  sums[0] = sum_0;
  sums[1] = sum_1;
}
#else
static inline void sums_of_two(const int32_t *restrict weight, const int32_t *restrict bias,
                               const int32_t *restrict x, uint32_t columns, int64_t sums[2]) {
  int64_t sum_0 = qj_long(bias);
  int64_t sum_1 = qj_long(bias + 2);
  for (const int32_t *const end = x + columns; x != end; x += COLUMNS_PER_TURN) {
    for (uint32_t column = 0U; column < (uint32_t)COLUMNS_PER_TURN; ++column) {
      const int64_t value = x[column];
      sum_0 += weight[0] * value;
      sum_1 += weight[1] * value;
      weight += ROWS_PER_BLOCK;
    }
  }
  sums[0] = sum_0;
  sums[1] = sum_1;
}
#endif

KERNEL void sums_scalar(const int32_t *restrict weight, const int32_t *restrict bias,
                        const int32_t *restrict x, uint32_t columns,
                        int64_t sums[ROWS_PER_BLOCK]) {
  sums_of_two(weight, bias, x, columns, sums);
  sums_of_two(weight + 2, bias + 4, x, columns, sums + 2);
}

#if QJ_HAS_NEON
#if NEON_NEEDS_TARGET
#pragma GCC push_options
#pragma GCC target("fpu=neon")
#endif
/* The sum of the two lanes of each. */
static inline int64x2_t lane_sums(int64x2_t a, int64x2_t b) {
  return vaddq_s64(vcombine_s64(vget_low_s64(a), vget_low_s64(b)),
                   vcombine_s64(vget_high_s64(a), vget_high_s64(b)));
}

static inline int64x2_t two_longs(const int32_t *words) {
  return vreinterpretq_s64_s32(vld1q_s32(words));
}

/* One register per row: its lanes sum even and odd columns apart, and the four rows are four
 * independent chains. vld4 takes four columns of the block and hands them over row by row. */
KERNEL void sums_neon(const int32_t *restrict weight, const int32_t *restrict bias,
                      const int32_t *restrict x, uint32_t columns, int64_t sums[ROWS_PER_BLOCK]) {
  int64x2_t sum_0 = vdupq_n_s64(0);
  int64x2_t sum_1 = vdupq_n_s64(0);
  int64x2_t sum_2 = vdupq_n_s64(0);
  int64x2_t sum_3 = vdupq_n_s64(0);
  for (const int32_t *const end = x + columns; x != end; x += 4) {
    const int32x4x4_t row = vld4q_s32(weight);
    const int32x4_t value = vld1q_s32(x);
    sum_0 = vmlal_s32(sum_0, vget_low_s32(row.val[0]), vget_low_s32(value));
    sum_1 = vmlal_s32(sum_1, vget_low_s32(row.val[1]), vget_low_s32(value));
    sum_2 = vmlal_s32(sum_2, vget_low_s32(row.val[2]), vget_low_s32(value));
    sum_3 = vmlal_s32(sum_3, vget_low_s32(row.val[3]), vget_low_s32(value));
    sum_0 = vmlal_s32(sum_0, vget_high_s32(row.val[0]), vget_high_s32(value));
    sum_1 = vmlal_s32(sum_1, vget_high_s32(row.val[1]), vget_high_s32(value));
    sum_2 = vmlal_s32(sum_2, vget_high_s32(row.val[2]), vget_high_s32(value));
    sum_3 = vmlal_s32(sum_3, vget_high_s32(row.val[3]), vget_high_s32(value));
    weight += 4 * ROWS_PER_BLOCK;
  }
  vst1q_s64(sums, vaddq_s64(two_longs(bias), lane_sums(sum_0, sum_1)));
  vst1q_s64(sums + 2, vaddq_s64(two_longs(bias + 4), lane_sums(sum_2, sum_3)));
}
#if NEON_NEEDS_TARGET
#pragma GCC pop_options
#endif
#endif

static inline void block_sums(qj_kernel kernel, const int32_t *weight, const int32_t *bias,
                              const int32_t *x, uint32_t columns, int64_t sums[ROWS_PER_BLOCK]) {
#if QJ_HAS_NEON
  if (kernel == QJ_NEON) {
    sums_neon(weight, bias, x, columns, sums);
    return;
  }
#else
  (void)kernel;
#endif
  sums_scalar(weight, bias, x, columns, sums);
}

static void digest_sums(uint32_t *trace, const int64_t *sums, uint32_t rows) {
  for (uint32_t row = 0U; (row < rows) && (row < ROWS_PER_BLOCK); ++row) {
    *trace = qj_digest_long(*trace, sums[row]);
  }
}

/* ReLU, rounding and requantization in one: the upper word, or zero if it is negative. */
static inline int32_t relu_upper_word(int64_t sum) {
  const int32_t upper = (int32_t)(sum >> WORD);
  return (upper > 0) ? upper : 0;
}

static void hidden_layer(qj_kernel kernel, const qj_layer *layer, const int32_t *x, int32_t *y,
                         uint32_t *trace) {
  const uint32_t columns = layer->padded_columns;
  const uint32_t rows = layer->padded_rows;
  const int32_t *weight = layer->weights;
  const int32_t *bias = layer->bias;
  for (uint32_t row = 0U; row < rows; row += ROWS_PER_BLOCK) {
    int64_t sums[ROWS_PER_BLOCK];
    block_sums(kernel, weight, bias, x, columns, sums);
    y[row] = relu_upper_word(sums[0]);
    y[row + 1U] = relu_upper_word(sums[1]);
    y[row + 2U] = relu_upper_word(sums[2]);
    y[row + 3U] = relu_upper_word(sums[3]);
    if ((trace != 0) && (row < layer->rows)) {
      digest_sums(trace, sums, layer->rows - row);
    }
    weight += ROWS_PER_BLOCK * columns;
    bias += 2 * ROWS_PER_BLOCK;
  }
}

void qj_run_layers(const qj_policy *policy, const qj_layer *layer, uint32_t count,
                   int32_t buffer[2][QJ_MAX_WIDTH], int64_t sums[QJ_COMMANDS], uint32_t *trace) {
  const uint32_t last = count - 1U;
  for (uint32_t i = 0U; i < last; ++i) {
    hidden_layer(policy->kernel, &layer[i], buffer[i & 1U], buffer[(i + 1U) & 1U], trace);
  }
  block_sums(policy->kernel, layer[last].weights, layer[last].bias, buffer[last & 1U],
             layer[last].padded_columns, sums);
}

qj_status qj_quantize(const qj_policy *policy, const float *x, int32_t *q) {
  qj_status status = {0U, 0U, 0U};
  const int32_t *part = policy->part;
  for (uint32_t number = 0U; number < policy->parts; ++number) {
    const int32_t exponent = part[QJ_PART_EXPONENT];
    const uint32_t end = (uint32_t)(part[QJ_PART_INDEX] + part[QJ_PART_SIZE]);
    for (uint32_t i = (uint32_t)part[QJ_PART_INDEX]; i < end; ++i) {
      uint32_t clipped;
      uint32_t nan;
      q[i] = qj_quantize_one(qj_bits(x[i]), exponent, &clipped, &nan);
      qj_flag(&status.clipped, i, clipped);
      qj_flag(&status.nan, i, nan);
    }
    part += QJ_PART_WORDS;
  }
  return status;
}

void qj_forward(const qj_policy *policy, const int32_t *q, int32_t command[QJ_COMMANDS],
                uint32_t *trace) {
  QJ_BUFFER int32_t buffer[2][QJ_MAX_WIDTH];
  int64_t sums[ROWS_PER_BLOCK];
  for (uint32_t i = 0U; i < policy->inputs; ++i) {
    const int32_t high = (q[i] > QJ_INPUT_ONE) ? QJ_INPUT_ONE : q[i];
    buffer[0][i] = (high < -QJ_INPUT_ONE) ? -QJ_INPUT_ONE : high;
  }
  for (uint32_t i = policy->inputs; i < policy->layer[0].padded_columns; ++i) {
    buffer[0][i] = 0;
  }
  if (trace != 0) {
    *trace = QJ_DIGEST_START;
  }
  qj_run_layers(policy, policy->layer, policy->layers, buffer, sums, trace);
  if (trace != 0) {
    digest_sums(trace, sums, QJ_COMMANDS);
  }
  /* Clamped in the sum's own units: a limit is below 2^31 and the shift at most 32. */
  const int64_t unit = INT64_C(1) << policy->output_shift;
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    const int64_t sum = qj_clamp(sums[i], policy->low[i] * unit, policy->high[i] * unit);
    command[i] = (int32_t)(sum >> policy->output_shift);
  }
}

void qj_commands(const qj_policy *policy, const int32_t q[QJ_COMMANDS],
                 float command[QJ_COMMANDS]) {
  const uint32_t bits = policy->fraction_bits;
  const float unit = 1.0F / (float)(UINT32_C(1) << bits); /* a power of two */
  const int64_t half = (bits > 0U) ? INT64_C(1) << (bits - 1U) : 0;
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    command[i] = (policy->kind == QJ_RPM) ? (float)(int32_t)((q[i] + half) >> bits) : (float)q[i] * unit;
  }
}
