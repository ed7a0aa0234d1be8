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
enum { ROWS_PER_BLOCK = 4 };

/* The kernels stay functions of their own: they need all registers, and clang with NEON would take
 * their sums and what follows for vectors and emulate products of 64 bits. */
#if defined(__GNUC__)
#define KERNEL __attribute__((noinline)) static
#else
#define KERNEL static inline
#endif

/* A block of four rows. The assembly knows the places of these. */
typedef struct {
  const int32_t *weight;
  const int32_t *end; /* of the inputs */
  const int32_t *x;
  const int32_t *bias;
  int64_t *sums;
  int32_t *y; /* of each sum the upper word, or zero if it is negative */
} block;

/* QJ_PORTABLE leaves the assembly out. */
#if defined(__arm__) && defined(__GNUC__) && defined(__ARM_ARCH) && !defined(QJ_PORTABLE)
#if (__ARM_ARCH >= 7) && (defined(__ARM_ARCH_ISA_ARM) || (__ARM_ARCH_ISA_THUMB >= 2))
#define HAS_SMLAL 1
#endif
#endif

#ifdef HAS_SMLAL
/* Every ARMv7 has LDRD and SMLAL, Cortex-M included; compilers use the first one rarely. Two rows at
 * a time: their sums, their weights and the inputs are what the registers of a 32-bit ARM hold. The
 * weights are at r6, the inputs at lr, their end in the register that is no frame pointer, and the
 * block is on the stack. */
#ifdef __thumb__
#define END "r11"
#else
#define END "r7"
#endif
#define SUMS "{r8, r9, r10, r12}\n\t"
#define TWO_COLUMNS(first, second) \
  "ldrd r4, r5, [lr], #8\n\t" first "ldrd r2, r3, [r6, #" second "]\n\t" \
  "smlal r8, r9, r0, r4\n\tsmlal r10, r12, r1, r4\n\t" \
  "smlal r8, r9, r2, r5\n\tsmlal r10, r12, r3, r5\n\t"
#define WEIGHTS(offset) "ldrd r0, r1, [r6, #" offset "]\n\t"
#define TWO_ROWS(label) \
  label ":\n\t" TWO_COLUMNS("ldrd r0, r1, [r6], #128\n\t", "-112") \
  TWO_COLUMNS(WEIGHTS("-96"), "-80") TWO_COLUMNS(WEIGHTS("-64"), "-48") \
  TWO_COLUMNS(WEIGHTS("-32"), "-16") "cmp lr, " END "\n\tbne " label "b\n\t"
#define UPPER_WORDS "bic r0, r9, r9, asr #31\n\tbic r1, r12, r12, asr #31\n\t"

static inline void block_sums(const block *of) {
  register const block *r0 __asm__("r0") = of;
  __asm__ volatile(
      "push {r0}\n\tldm r0, {r6, " END ", lr}\n\tldr r0, [r0, #12]\n\tldm r0, " SUMS
      TWO_ROWS("1")
      "ldr r5, [sp]\n\tldm r5, {r0, r1, r2, r3, r4, r5}\n\tstm r4, " SUMS
      "add r6, r0, #8\n\tmov lr, r2\n\t" UPPER_WORDS "strd r0, r1, [r5]\n\t"
      "add r3, r3, #16\n\tldm r3, " SUMS
      TWO_ROWS("2")
      "pop {r0}\n\tldrd r4, r5, [r0, #16]\n\tadd r4, r4, #16\n\tstm r4, " SUMS
      UPPER_WORDS "strd r0, r1, [r5, #8]"
      : "+r"(r0)
      :
      : "r1", "r2", "r3", "r4", "r5", "r6", END, "r8", "r9", "r10", "r12", "lr", "cc", "memory");
}
#else
static inline void block_sums(const block *of) {
  const int32_t *weight = of->weight;
  for (uint32_t row = 0U; row < (uint32_t)ROWS_PER_BLOCK; ++row) {
    of->sums[row] = qj_long(of->bias + 2U * row);
  }
  for (const int32_t *x = of->x; x != of->end; ++x) {
    for (uint32_t row = 0U; row < (uint32_t)ROWS_PER_BLOCK; ++row) {
      of->sums[row] += (int64_t)weight[row] * *x;
    }
    weight += ROWS_PER_BLOCK;
  }
  for (uint32_t row = 0U; row < (uint32_t)ROWS_PER_BLOCK; ++row) {
    const int32_t upper = (int32_t)(of->sums[row] >> WORD);
    of->y[row] = (upper > 0) ? upper : 0;
  }
}
#endif

static void digest_sums(uint32_t *trace, const int64_t *sums, uint32_t rows) {
  for (uint32_t row = 0U; (row < rows) && (row < ROWS_PER_BLOCK); ++row) {
    *trace = qj_digest_long(*trace, sums[row]);
  }
}

KERNEL void layer_scalar(const qj_layer *layer, const int32_t *x, int32_t *y,
                         int64_t sums[ROWS_PER_BLOCK], uint32_t *trace) {
  block of = {layer->weights, x + layer->padded_columns, x, layer->bias, sums, y};
  for (uint32_t row = 0U; row < layer->padded_rows; row += ROWS_PER_BLOCK) {
    block_sums(&of);
    if ((trace != 0) && (row < layer->rows)) {
      digest_sums(trace, sums, layer->rows - row);
    }
    of.weight += ROWS_PER_BLOCK * layer->padded_columns;
    of.bias += 2 * ROWS_PER_BLOCK;
    of.y += ROWS_PER_BLOCK;
  }
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
KERNEL void layer_neon(const qj_layer *layer, const int32_t *restrict x, int32_t *restrict y,
                       int64_t sums[ROWS_PER_BLOCK], uint32_t *trace) {
  const int32_t *weight = layer->weights;
  const int32_t *bias = layer->bias;
  const int32_t *const end = x + layer->padded_columns;
  for (uint32_t row = 0U; row < layer->padded_rows; row += ROWS_PER_BLOCK) {
    int64x2_t sum_0 = vdupq_n_s64(0);
    int64x2_t sum_1 = sum_0;
    int64x2_t sum_2 = sum_0;
    int64x2_t sum_3 = sum_0;
    for (const int32_t *at = x; at != end; at += 4) {
      const int32x4x4_t rows = vld4q_s32(weight);
      const int32x4_t value = vld1q_s32(at);
      sum_0 = vmlal_s32(sum_0, vget_low_s32(rows.val[0]), vget_low_s32(value));
      sum_1 = vmlal_s32(sum_1, vget_low_s32(rows.val[1]), vget_low_s32(value));
      sum_2 = vmlal_s32(sum_2, vget_low_s32(rows.val[2]), vget_low_s32(value));
      sum_3 = vmlal_s32(sum_3, vget_low_s32(rows.val[3]), vget_low_s32(value));
      sum_0 = vmlal_s32(sum_0, vget_high_s32(rows.val[0]), vget_high_s32(value));
      sum_1 = vmlal_s32(sum_1, vget_high_s32(rows.val[1]), vget_high_s32(value));
      sum_2 = vmlal_s32(sum_2, vget_high_s32(rows.val[2]), vget_high_s32(value));
      sum_3 = vmlal_s32(sum_3, vget_high_s32(rows.val[3]), vget_high_s32(value));
      weight += 4 * ROWS_PER_BLOCK;
    }
    const int64x2_t first = vaddq_s64(two_longs(bias), lane_sums(sum_0, sum_1));
    const int64x2_t second = vaddq_s64(two_longs(bias + 4), lane_sums(sum_2, sum_3));
    const int32x4_t upper = vcombine_s32(vshrn_n_s64(first, WORD), vshrn_n_s64(second, WORD));
    vst1q_s32(y + row, vmaxq_s32(upper, vdupq_n_s32(0)));
    vst1q_s64(sums, first);
    vst1q_s64(sums + 2, second);
    if ((trace != 0) && (row < layer->rows)) {
      digest_sums(trace, sums, layer->rows - row);
    }
    bias += 2 * ROWS_PER_BLOCK;
  }
}
#if NEON_NEEDS_TARGET
#pragma GCC pop_options
#endif
#endif

void qj_run_layers(const qj_policy *policy, const qj_layer *layer, uint32_t count,
                   int32_t buffer[2][QJ_MAX_WIDTH], int64_t sums[QJ_COMMANDS], uint32_t *trace) {
  for (uint32_t i = 0U; i < count; ++i) {
    const int32_t *const x = buffer[i & 1U];
    int32_t *const y = buffer[(i + 1U) & 1U];
#if QJ_HAS_NEON
    if (policy->kernel == QJ_NEON) {
      layer_neon(&layer[i], x, y, sums, trace);
      continue;
    }
#else
    (void)policy;
#endif
    layer_scalar(&layer[i], x, y, sums, trace);
  }
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
  int32_t buffer[2][QJ_MAX_WIDTH];
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
  /* Clamped in the sum's own units: a limit is below 2^31 and the shift at most 32. */
  const int64_t unit = INT64_C(1) << policy->output_shift;
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    const int64_t sum = qj_clamp(sums[i], policy->low[i] * unit, policy->high[i] * unit);
    command[i] = (int32_t)(sum >> policy->output_shift);
  }
}

#ifdef QJ_SAMPLED
/* 32 bits: a hash (lowbias32 of C. Wellons) of a counter that steps by 2^32 over the golden ratio. */
static inline uint32_t next_bits(uint32_t *counter) {
  *counter += UINT32_C(0x9E3779B9);
  uint32_t x = *counter;
  x = (x ^ (x >> 16)) * UINT32_C(0x7FEB352D);
  x = (x ^ (x >> 15)) * UINT32_C(0x846CA68B);
  return x ^ (x >> 16);
}

/* A sum of 12 uniform numbers of 16 bits: normal, of mean 0 and standard deviation 2^16, within 6 of
 * those. No branch and no address depends on a number. Times a factor it is below 2^50. */
static inline int64_t noise_of(uint32_t *counter, int32_t factor) {
  int32_t sum = -6 * 0xFFFF;
  for (uint32_t i = 0U; i < 6U; ++i) {
    const uint32_t bits = next_bits(counter);
    sum += (int32_t)(bits & UINT32_C(0xFFFF)) + (int32_t)(bits >> 16);
  }
  return qj_round_shift((int64_t)sum * factor, 16);
}

uint32_t qj_noise_digest(const int32_t *noise) {
  uint32_t counter = 0U;
  uint32_t digest = QJ_DIGEST_START;
  for (uint32_t i = 0U; i < QJ_TEST_SAMPLES * QJ_COMMANDS; ++i) {
    digest = qj_digest_long(digest, noise_of(&counter, noise[QJ_NOISE_FACTOR + i % QJ_COMMANDS]));
  }
  return digest;
}

void qj_sample(const qj_policy *policy, const int32_t *q, uint32_t *counter,
               int32_t command[QJ_COMMANDS]) {
  int32_t buffer[2][QJ_MAX_WIDTH];
  int64_t sums[ROWS_PER_BLOCK];
  if (policy->noise == 0) {
    qj_forward(policy, q, command, 0);
    return;
  }
  for (uint32_t i = 0U; i < policy->layer[0].padded_columns; ++i) {
    const int64_t input = (i < policy->inputs) ? q[i] : 0;
    buffer[0][i] = (int32_t)qj_clamp(input, -QJ_INPUT_ONE, QJ_INPUT_ONE);
  }
  qj_run_layers(policy, policy->layer, policy->layers, buffer, sums, 0);
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) { /* a shift of at least 1: below 2^62 and 2^50 */
    const int64_t noise = noise_of(counter, policy->noise[QJ_NOISE_FACTOR + i]);
    const int64_t sum = sums[i] >> policy->output_shift;
    const int64_t clamped = qj_clamp(sum, policy->low[i], policy->high[i]);
    const int64_t mean = (policy->noise[QJ_NOISE_ON_CLAMPED] != 0) ? clamped : sum;
    command[i] = (int32_t)qj_clamp(mean + noise, policy->low[i], policy->high[i]);
  }
}
#endif

void qj_commands(const qj_policy *policy, const int32_t q[QJ_COMMANDS],
                 float command[QJ_COMMANDS]) {
  const uint32_t bits = policy->fraction_bits;
  const float unit = 1.0F / (float)(UINT32_C(1) << bits); /* a power of two */
  const int64_t half = (bits > 0U) ? INT64_C(1) << (bits - 1U) : 0;
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    command[i] = (policy->kind == QJ_RPM) ? (float)(int32_t)((q[i] + half) >> bits) : (float)q[i] * unit;
  }
}
