/*
 * The network: see qj.h.
 *
 * Every hidden neuron is  y = max(0, (bias + sum of weight * x) >> 32),  the rounding half folded
 * into its bias: ReLU, rounding and requantization are one shift by a whole word. quadjax export
 * proves for every input that no partial sum reaches 2^63 and no y exceeds 2^30 - 1. Right shifts
 * of negative numbers are arithmetic, as in every compiler that this is for; the self-test would
 * see it otherwise.
 */
#include <math.h>
#include <stddef.h>

#include "qj.h"

enum { WORD = 32 };

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

/* Tables are in blocks of four rows; within a block, the four weights of column 0, then of 1 .. */
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
  const int64_t *bias;
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
/* Every ARMv7 has LDRD and SMLAL, Cortex-M included; compilers use the first one rarely. Two rows
 * at a time: their sums, their weights and the inputs are what the registers of a 32-bit ARM hold.
 * The weights are at r6, the inputs at lr, their end in the register that is no frame pointer, and
 * the block is on the stack. */
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
    of->sums[row] = of->bias[row];
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

/* FNV-1a over words. */
#define DIGEST_START UINT32_C(2166136261)
static inline uint32_t digest(uint32_t value, uint32_t word) {
  return (value ^ word) * UINT32_C(16777619);
}

static inline uint32_t digest_long(uint32_t value, int64_t wide) {
  return digest(digest(value, (uint32_t)(uint64_t)wide), (uint32_t)((uint64_t)wide >> WORD));
}

static void digest_sums(uint32_t *trace, const int64_t *sums, uint32_t rows) {
  for (uint32_t row = 0U; (row < rows) && (row < ROWS_PER_BLOCK); ++row) {
    *trace = digest_long(*trace, sums[row]);
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
    of.bias += ROWS_PER_BLOCK;
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

/* One register per row: its lanes sum even and odd columns apart, and the four rows are four
 * independent chains. vld4 takes four columns of the block and hands them over row by row. */
KERNEL void layer_neon(const qj_layer *layer, const int32_t *restrict x, int32_t *restrict y,
                       int64_t sums[ROWS_PER_BLOCK], uint32_t *trace) {
  const int32_t *weight = layer->weights;
  const int64_t *bias = layer->bias;
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
    const int64x2_t first = vaddq_s64(vld1q_s64(bias), lane_sums(sum_0, sum_1));
    const int64x2_t second = vaddq_s64(vld1q_s64(bias + 2), lane_sums(sum_2, sum_3));
    const int32x4_t upper = vcombine_s32(vshrn_n_s64(first, WORD), vshrn_n_s64(second, WORD));
    vst1q_s32(y + row, vmaxq_s32(upper, vdupq_n_s32(0)));
    vst1q_s64(sums, first);
    vst1q_s64(sums + 2, second);
    if ((trace != 0) && (row < layer->rows)) {
      digest_sums(trace, sums, layer->rows - row);
    }
    bias += ROWS_PER_BLOCK;
  }
}
#if NEON_NEEDS_TARGET
#pragma GCC pop_options
#endif
#endif

/* The sums of the output for inputs, which are held to their ranges. */
static void run(const qj_policy *policy, qj_kernel kernel, const int32_t *q,
                int64_t sums[ROWS_PER_BLOCK], uint32_t *trace) {
  int32_t buffer[2][QJ_MAX_WIDTH];
  for (uint32_t i = 0U; i < policy->inputs; ++i) {
    const int32_t high = (q[i] > QJ_ONE) ? QJ_ONE : q[i];
    buffer[0][i] = (high < -QJ_ONE) ? -QJ_ONE : high;
  }
  for (uint32_t i = policy->inputs; i < policy->layer[0].padded_columns; ++i) {
    buffer[0][i] = 0;
  }
  if (trace != 0) {
    *trace = DIGEST_START;
  }
  for (uint32_t i = 0U; i < policy->layers; ++i) {
#if QJ_HAS_NEON
    if (kernel == QJ_NEON) {
      layer_neon(&policy->layer[i], buffer[i & 1U], buffer[(i + 1U) & 1U], sums, trace);
      continue;
    }
#else
    (void)kernel;
#endif
    layer_scalar(&policy->layer[i], buffer[i & 1U], buffer[(i + 1U) & 1U], sums, trace);
  }
}

static inline int64_t limited(int64_t value, int64_t low, int64_t high) {
  return (value < low) ? low : ((value > high) ? high : value);
}

qj_status qj_quantize(const qj_policy *policy, const float *x, int32_t *q) {
  qj_status status = {0U, 0U};
  for (uint32_t i = 0U; i < policy->inputs; ++i) {
    const uint32_t bit = UINT32_C(1) << ((i < 31U) ? i : 31U);
    const float range = policy->input[i].range;
    const uint32_t is_finite = qj_is_finite(x[i]);
    const float value = (is_finite != 0U) ? x[i] : 0.0F;
    const float of_range = value / range; /* a power of two: exact */
    const float held = (of_range >= 1.0F) ? 1.0F : ((of_range > -1.0F) ? of_range : -1.0F);
    status.nan |= (is_finite != 0U) ? 0U : bit;
    status.outside |= (fabsf(of_range) > 1.0F) ? bit : 0U;
    q[i] = (int32_t)(held * (float)QJ_ONE); /* exact, truncated */
  }
  return status;
}

void qj_forward(const qj_policy *policy, qj_kernel kernel, const int32_t *q,
                int32_t command[QJ_COMMANDS], uint32_t *trace) {
  int64_t sums[ROWS_PER_BLOCK];
  run(policy, kernel, q, sums, trace);
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    const int64_t unit = INT64_C(1) << policy->output_shift; /* at most 2^32 */
    const int64_t sum = limited(sums[i], policy->low[i] * unit, policy->high[i] * unit);
    command[i] = (int32_t)(sum >> policy->output_shift);
  }
}

/* ---- commands -------------------------------------------------------------------------------- */

/* A number in (0, 1]: a hash (lowbias32 of C. Wellons) of a counter that steps by 2^32 over the
 * golden ratio. */
static float uniform(uint32_t *counter) {
  *counter += UINT32_C(0x9E3779B9);
  uint32_t x = *counter;
  x = (x ^ (x >> 16)) * UINT32_C(0x7FEB352D);
  x = (x ^ (x >> 15)) * UINT32_C(0x846CA68B);
  return (float)((x ^ (x >> 16)) >> 8) * 0x1p-24F + 0x1p-24F;
}

/* Two normal numbers, by Box and Muller. */
static void normal(uint32_t *counter, float pair[2]) {
  const float radius = sqrtf(-2.0F * logf(uniform(counter)));
  const float angle = 6.2831853071795865F * uniform(counter);
  pair[0] = radius * cosf(angle);
  pair[1] = radius * sinf(angle);
}

static float held_between(float value, float low, float high) {
  return (value < low) ? low : ((value > high) ? high : value);
}

/* A sum of the output with noise, in the unit of the command. */
static float sampled(const qj_policy *policy, uint32_t i, int64_t sum, float noise) {
  const int64_t wide = sum >> policy->output_shift;
  const int64_t held = limited(wide, policy->low[i], policy->high[i]);
  const float mean = (float)((policy->noise_on_clamped != 0U) ? held : wide);
  return mean / (float)(UINT32_C(1) << policy->fraction_bits) + noise;
}

void qj_act(const qj_policy *policy, qj_kernel kernel, const int32_t *q, uint32_t *counter,
            float command[QJ_COMMANDS]) {
  const uint32_t bits = policy->fraction_bits;
  const int64_t half = (bits > 0U) ? INT64_C(1) << (bits - 1U) : 0;
  const uint32_t is_sampled = ((counter != 0) && (policy->noise != 0)) ? 1U : 0U;
  const uint32_t is_rpm = (policy->kind == QJ_RPM) ? 1U : 0U;
  float noise[QJ_COMMANDS];
  int64_t sums[ROWS_PER_BLOCK];
  run(policy, kernel, q, sums, 0);
  for (uint32_t i = 0U; (is_sampled != 0U) && (i < QJ_COMMANDS); i += 2U) {
    normal(counter, noise + i);
  }
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    const float unit = 1.0F / (float)(UINT32_C(1) << bits);
    const int64_t held = limited(sums[i] >> policy->output_shift, policy->low[i], policy->high[i]);
    float value = (is_rpm != 0U) ? (float)(int32_t)((held + half) >> bits) : (float)held * unit;
    if (is_sampled != 0U) {
      value = sampled(policy, i, sums[i], noise[i] * policy->noise[i]);
      value = (is_rpm != 0U) ? floorf(value + 0.5F) : value;
    }
    command[i] = held_between(value, (float)policy->low[i] * unit, (float)policy->high[i] * unit);
  }
}

/* ---- the self-test --------------------------------------------------------------------------- */

/* Of words of four bytes, the low one first. */
static uint32_t digest_words(uint32_t value, const void *words, uint32_t count) {
  const unsigned char *byte = words;
  for (uint32_t i = 0U; i < count; ++i, byte += 4) {
    value = digest(value, (uint32_t)byte[0] | ((uint32_t)byte[1] << 8) | ((uint32_t)byte[2] << 16) |
                              ((uint32_t)byte[3] << 24));
  }
  return value;
}

static uint32_t digest_network(uint32_t hash, const qj_float_layer *layer, uint32_t layers) {
  for (uint32_t i = 0U; i < layers; ++i) {
    hash = digest_words(hash, layer[i].weights, layer[i].rows * layer[i].columns);
    hash = digest_words(hash, layer[i].bias, layer[i].rows);
  }
  return hash;
}

#define WORDS_OF(object) ((uint32_t)(sizeof(object) / 4U))

static uint32_t digest_estimators(uint32_t hash, const qj_policy *policy) {
  if (policy->disturbance != 0) {
    const qj_residual *const residual = policy->disturbance->residual;
    hash = digest_words(hash, policy->disturbance, offsetof(qj_disturbance_model, residual) / 4U);
    if (residual != 0) {
      hash = digest_words(hash, &residual->low_rpm, 1U);
      hash = digest_words(hash, &residual->high_rpm, 1U);
      hash = digest_network(hash, residual->thrust, residual->thrust_layers);
      hash = digest_network(hash, residual->moment, residual->moment_layers);
    }
  }
  if (policy->battery != 0) {
    hash = digest_words(hash, policy->battery, WORDS_OF(qj_battery_model));
  }
  return (policy->noise != 0) ? digest_words(hash, policy->noise, QJ_COMMANDS) : hash;
}

/* Of all tables and numbers. */
static uint32_t hash_of(const qj_policy *policy) {
  const uint32_t numbers[] = {(uint32_t)policy->kind, policy->inputs, policy->layers, policy->parts,
                              policy->gates, policy->gate_constants, policy->output_shift,
                              policy->fraction_bits, (uint32_t)policy->gate_test,
                              policy->noise_on_clamped};
  uint32_t hash = digest_words(DIGEST_START, numbers, WORDS_OF(numbers));
  hash = digest_words(hash, &policy->step_s, 1U);
  hash = digest_words(hash, policy->low, QJ_COMMANDS);
  hash = digest_words(hash, policy->high, QJ_COMMANDS);
  for (uint32_t i = 0U; i < policy->layers; ++i) {
    const qj_layer *const layer = &policy->layer[i];
    hash = digest_words(hash, layer->weights, layer->padded_rows * layer->padded_columns);
    hash = digest_words(hash, layer->bias, 2U * layer->padded_rows);
  }
  hash = digest_words(hash, policy->part, policy->parts * WORDS_OF(qj_part));
  hash = digest_words(hash, policy->input, policy->inputs * WORDS_OF(qj_input));
  hash = digest_words(hash, policy->gate, policy->gates * WORDS_OF(qj_gate));
  hash = digest_words(hash, policy->gate_constant, policy->gates * policy->gate_constants);
  return digest_estimators(hash, policy);
}

uint32_t qj_self_test(const qj_policy *policy, qj_kernel kernel) {
  uint32_t passed = (hash_of(policy) == policy->hash) ? 1U : 0U;
  for (uint32_t i = 0U; i < policy->tests; ++i) {
    const int32_t *const expected = policy->test_command + QJ_COMMANDS * i;
    int32_t command[QJ_COMMANDS];
    uint32_t trace;
    qj_forward(policy, kernel, policy->test_input + policy->inputs * i, command, &trace);
    passed &= (trace == policy->test_trace[i]) ? 1U : 0U;
    for (uint32_t k = 0U; k < QJ_COMMANDS; ++k) {
      passed &= (command[k] == expected[k]) ? 1U : 0U;
    }
  }
  return passed;
}
