{% import "helpers.c" as c %}
/*
 * ${name}: see ${name}.h.
 *
${origin.lines | comment}
 *
 * Every hidden neuron is  y = max(0, (bias + sum of weight * x) >> 32),  the rounding half folded
 * into its bias: ReLU, rounding and requantisation are one shift by a whole word. Its scale is
 * absorbed into the next layer's weights. The converter has proven, in exact integers from the box
 * of inputs on, that no partial sum reaches 2^63 and no y exceeds 2^30 - 1.
 *
 * Right shifts of negative numbers are arithmetic, as in every compiler for every processor that
 * this may run on; the self-test would see it otherwise.
 */
#include "${name}.h"

#if ${NAME}_HAS_NEON
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

/* Tables are in blocks of four rows; within a block, the four weights of column 0, of column 1 ...
 * Columns are padded with zeros to a multiple of eight, and the rows of a hidden layer likewise. */
enum {
  ROWS_PER_BLOCK = 4,
  COLUMNS_PER_LOAD = 4, /* of the NEON kernel */
{% for layer in layers %}
  ROWS_${loop.index0} = ${layer.rows}, PADDED_ROWS_${loop.index0} = ${layer.bias.size}, COLUMNS_${loop.index0} = ${layer.columns},
{% endfor %}
  WIDEST = ${layers | map(attribute="columns") | max}, /* the longest vector between two layers, padded */
  TEST_VECTORS = ${test.inputs | length}
};

{% for layer in layers %}
/* Layer ${loop.index0}: ${layer.rows} rows of ${layer.columns} columns, padded. */
${table("int32_t", "weight_" ~ loop.index0, layer.weights)}

${table("int64_t", "bias_" ~ loop.index0, layer.bias)}

{% endfor %}
/* ---- inputs ---------------------------------------------------------------------------------- */

/* A float of magnitude 2^e has the exponent field 127 + e. */
static const int8_t range_exponent[${NAME}_INPUTS] = {${network.box.exponents | join(", ")}};

{% include "quantize_one.c" %}

${name}_status ${name}_quantize(const float x[${NAME}_INPUTS], int32_t q[${NAME}_INPUTS]) {
  ${name}_status status = {0U, 0U};
${c.quantize_all("q", NAME ~ "_INPUTS", name ~ "_quantize_one(float_bits(x[i]), range_exponent[i]", network.inputs)}
/* ---- one block of four rows ------------------------------------------------------------------- */

/* For clang with NEON the kernels stay functions of their own: inlined, it would take their sums and
 * what follows for vectors and emulate products of 64 bits. */
#if defined(__clang__) && (${NAME}_HAS_NEON)
#define KERNEL __attribute__((noinline)) static
#else
#define KERNEL static
#endif

{% include "scalar_kernel.c" %}

#if ${NAME}_HAS_NEON
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
KERNEL void sums_neon(const int32_t *restrict weight, const int64_t *restrict bias,
                      const int32_t *restrict x, uint32_t columns, int64_t sums[ROWS_PER_BLOCK]) {
  int64x2_t sum_0 = vdupq_n_s64(0);
  int64x2_t sum_1 = vdupq_n_s64(0);
  int64x2_t sum_2 = vdupq_n_s64(0);
  int64x2_t sum_3 = vdupq_n_s64(0);
  for (const int32_t *const end = x + columns; x != end; x += COLUMNS_PER_LOAD) {
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
    weight += COLUMNS_PER_LOAD * ROWS_PER_BLOCK;
  }
  vst1q_s64(sums, vaddq_s64(vld1q_s64(bias), lane_sums(sum_0, sum_1)));
  vst1q_s64(sums + 2, vaddq_s64(vld1q_s64(bias + 2), lane_sums(sum_2, sum_3)));
}
#if NEON_NEEDS_TARGET
#pragma GCC pop_options
#endif
#endif

static void block_sums(${name}_kernel kernel, const int32_t *weight, const int64_t *bias,
                       const int32_t *x, uint32_t columns, int64_t sums[ROWS_PER_BLOCK]) {
#if ${NAME}_HAS_NEON
  if (kernel == ${NAME}_NEON) {
    sums_neon(weight, bias, x, columns, sums);
    return;
  }
#else
  (void)kernel;
#endif
  sums_scalar(weight, bias, x, columns, sums);
}

/* ---- layers ----------------------------------------------------------------------------------- */

{% include "digest.c" %}

{% if network.hidden %}
/* ReLU, rounding and requantisation in one: the upper word, or zero if it is negative. */
${c.relu_upper_word(32)}
/* rows is what the policy has: the sums of the padding are not digested. */
static void hidden_layer(${name}_kernel kernel, const int32_t *weight, const int64_t *bias,
                         uint32_t rows, uint32_t padded_rows, uint32_t columns, const int32_t *x,
                         int32_t *y, uint32_t *trace) {
  for (uint32_t row = 0U; row < padded_rows; row += ROWS_PER_BLOCK) {
    int64_t sums[ROWS_PER_BLOCK];
    block_sums(kernel, weight, bias + row, x, columns, sums);
    y[row] = relu_upper_word(sums[0]);
    y[row + 1U] = relu_upper_word(sums[1]);
    y[row + 2U] = relu_upper_word(sums[2]);
    y[row + 3U] = relu_upper_word(sums[3]);
    if ((trace != 0) && (row < rows)) {
      digest_sums(trace, sums, (rows - row < ROWS_PER_BLOCK) ? rows - row : ROWS_PER_BLOCK);
    }
    weight += ROWS_PER_BLOCK * columns;
  }
}
{% endif %}

static int32_t clamp_input(int32_t value) {
  value = (value > ${NAME}_INPUT_ONE) ? ${NAME}_INPUT_ONE : value;
  return (value < -${NAME}_INPUT_ONE) ? -${NAME}_INPUT_ONE : value;
}

/* Clamped in the accumulator's own units, so that the shift cannot overflow. */
${table("int64_t", "sum_low", network.command_low * 2**network.output_shift)}
${table("int64_t", "sum_high", network.command_high * 2**network.output_shift)}

static int32_t output_command(int64_t sum, uint32_t i) {
  const int64_t low = sum_low[i];
  const int64_t high = sum_high[i];
  sum = (sum < low) ? low : sum;
  sum = (sum > high) ? high : sum;
  return (int32_t)(sum >> ${network.output_shift});
}

/* One inference. trace is where to digest the accumulators, or 0. */
static void forward(${name}_kernel kernel, const int32_t q[${NAME}_INPUTS],
                    int32_t command[${NAME}_OUTPUTS], uint32_t *trace) {
  int32_t a[WIDEST];
{% if network.hidden %}
  int32_t b[WIDEST];
{% endif %}
  int64_t sums[ROWS_PER_BLOCK];
  for (uint32_t i = 0U; i < ${NAME}_INPUTS; ++i) {
    a[i] = clamp_input(q[i]);
  }
  for (uint32_t i = ${NAME}_INPUTS; i < COLUMNS_0; ++i) {
    a[i] = 0;
  }
{% for layer in layers %}
{% set i = loop.index0 %}
{% set x, y = ("a", "b") if i % 2 == 0 else ("b", "a") %}
{% if loop.last %}
  block_sums(kernel, weight_${i}, bias_${i}, ${x}, COLUMNS_${i}, sums);
{% else %}
  hidden_layer(kernel, weight_${i}, bias_${i}, ROWS_${i}, PADDED_ROWS_${i}, COLUMNS_${i}, ${x}, ${y}, trace);
{% endif %}
{% endfor %}
  if (trace != 0) {
    digest_sums(trace, sums, ${NAME}_OUTPUTS);
  }
  for (uint32_t i = 0U; i < ${NAME}_OUTPUTS; ++i) {
    command[i] = output_command(sums[i], i);
  }
}

/* ---- the public functions ---------------------------------------------------------------------- */

void ${name}_forward_q_with(${name}_kernel kernel, const int32_t q[${NAME}_INPUTS],
                           int32_t command[${NAME}_OUTPUTS]) {
  forward(kernel, q, command, 0);
}

void ${name}_forward_q(const int32_t q[${NAME}_INPUTS], int32_t command[${NAME}_OUTPUTS]) {
  forward(${NAME}_DEFAULT_KERNEL, q, command, 0);
}

uint32_t ${name}_forward_traced(${name}_kernel kernel, const int32_t q[${NAME}_INPUTS],
                               int32_t command[${NAME}_OUTPUTS]) {
  uint32_t trace = DIGEST_START;
  forward(kernel, q, command, &trace);
  return trace;
}

void ${name}_command(const int32_t q[${NAME}_OUTPUTS], ${command_type} command[${NAME}_OUTPUTS]) {
  for (uint32_t i = 0U; i < ${NAME}_OUTPUTS; ++i) {
{% if rpm %}
    command[i] = (uint16_t)((q[i] + (INT32_C(1) << ${network.fraction_bits - 1})) >> ${network.fraction_bits});
{% else %}
    command[i] = (float)q[i] * ${2.0 ** -network.fraction_bits}F; /* exact: 2^-${network.fraction_bits} */
{% endif %}
  }
}

${name}_status ${name}_forward_with(${name}_kernel kernel, const float x[${NAME}_INPUTS],
                                  ${command_type} command[${NAME}_OUTPUTS]) {
  int32_t q[${NAME}_INPUTS];
  int32_t integers[${NAME}_OUTPUTS];
  const ${name}_status status = ${name}_quantize(x, q);
  forward(kernel, q, integers, 0);
  ${name}_command(integers, command);
  return status;
}

${name}_status ${name}_forward(const float x[${NAME}_INPUTS], ${command_type} command[${NAME}_OUTPUTS]) {
  return ${name}_forward_with(${NAME}_DEFAULT_KERNEL, x, command);
}

/* ---- self-test ---------------------------------------------------------------------------------- */

#define TABLES_HASH UINT32_C(${test.tables_hash})
{% for digest in test.probes %}
#define PROBE_${loop.index0} UINT32_C(${digest})
{% endfor %}
#define QUANTIZE_DIGEST UINT32_C(${test.quantize_digest})

/* ${test.kinds}. */
static const int32_t test_input[TEST_VECTORS][${network.inputs}] = {
${rows(test.inputs, "int32")}};

static const int32_t test_command[TEST_VECTORS][${network.outputs}] = {
${rows(test.commands, "int32")}};

/* Digest of every accumulator of each vector. */
static const uint32_t test_trace[TEST_VECTORS] = {
${test.traces | each("hex") | wrapped}};

/* Zeros, subnormals, ordinary and huge numbers, infinities and NaNs: in every position. */
static const uint32_t quantize_pattern[${test.patterns | length}] = {
${test.patterns | each("hex") | wrapped}};

static uint32_t quantize_fails(void) {
  uint32_t digest = DIGEST_START;
  for (uint32_t pattern = 0U; pattern < ${test.patterns | length}U; ++pattern) {
    for (uint32_t i = 0U; i < sizeof(range_exponent); ++i) {
      uint32_t clipped;
      uint32_t nan;
      const uint32_t bits = quantize_pattern[pattern];
      const int32_t q = ${name}_quantize_one(bits, range_exponent[i], &clipped, &nan);
      digest = digest_word(digest_word(digest_word(digest, (uint32_t)q), clipped), nan);
    }
  }
  return (digest != QUANTIZE_DIGEST) ? 1U : 0U;
}

static uint32_t digest_table_32(uint32_t digest, const int32_t *table, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    digest = digest_word(digest, (uint32_t)table[i]);
  }
  return digest;
}

static uint32_t digest_table_64(uint32_t digest, const int64_t *table, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    digest = digest_long(digest, table[i]);
  }
  return digest;
}

static uint32_t tables_hash(void) {
  uint32_t digest = DIGEST_START;
{% for layer in layers %}
  digest = digest_table_32(digest, weight_${loop.index0}, ${layer.weights.size}U);
  digest = digest_table_64(digest, bias_${loop.index0}, ${layer.bias.size}U);
{% endfor %}
  return digest;
}

/* Odd numbers below 2^16, none zero: every bit of every weight shows in a sum, and no table, not
 * even a corrupted one, can overflow. Returns the digest of the sums of one layer. */
static uint32_t probe_layer(${name}_kernel kernel, const int32_t *weight, const int64_t *bias,
                            uint32_t padded_rows, uint32_t columns) {
  int32_t x[WIDEST];
  uint32_t state = 1U;
  uint32_t digest = DIGEST_START;
  for (uint32_t i = 0U; i < columns; ++i) {
    state = state * UINT32_C(1664525) + UINT32_C(1013904223);
    x[i] = (int32_t)((state >> 16) | 1U);
  }
  for (uint32_t row = 0U; row < padded_rows; row += ROWS_PER_BLOCK) {
    int64_t sums[ROWS_PER_BLOCK];
    block_sums(kernel, weight, bias + row, x, columns, sums);
    digest_sums(&digest, sums, ROWS_PER_BLOCK);
    weight += ROWS_PER_BLOCK * columns;
  }
  return digest;
}

static uint32_t vector_fails(${name}_kernel kernel, uint32_t number) {
  int32_t command[${NAME}_OUTPUTS];
  uint32_t wrong = ${name}_forward_traced(kernel, test_input[number], command) ^ test_trace[number];
  for (uint32_t i = 0U; i < ${NAME}_OUTPUTS; ++i) {
    wrong |= (uint32_t)(command[i] ^ test_command[number][i]);
  }
  return (wrong != 0U) ? 1U : 0U;
}

uint32_t ${name}_self_test_with(${name}_kernel kernel) {
  uint32_t mismatches = (tables_hash() != TABLES_HASH) ? 1U : 0U;
{% for layer in layers %}
{% set i = loop.index0 %}
  mismatches += (probe_layer(kernel, weight_${i}, bias_${i}, PADDED_ROWS_${i}, COLUMNS_${i}) != PROBE_${i}) ? 1U : 0U;
{% endfor %}
  for (uint32_t number = 0U; number < TEST_VECTORS; ++number) {
    mismatches += vector_fails(kernel, number);
  }
  mismatches += quantize_fails();
  return mismatches;
}

uint32_t ${name}_self_test(void) { return ${name}_self_test_with(${NAME}_DEFAULT_KERNEL); }
