/*
 * ${name}: a quadcopter racing policy in fixed point.
 *
${origin.lines | comment}
 *
 * Inputs are scaled by powers of two, weights are int32_t, sums are int64_t. No input whatever can
 * overflow: see ${name}_report.txt for the proof. Deterministic: the same bits on every processor.
 * Nothing here allocates, writes a global or calls a library; every function is re-entrant.
 *
 * Generated. Do not edit: the self-test compares the tables with their hash.
 */
#ifndef ${NAME}_H
#define ${NAME}_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ${NAME}_FORMAT_VERSION ${format_version}
#define ${NAME}_POLICY_SHA256 "${origin.policy_hash}"
#define ${NAME}_SOURCE ${origin.source | string}
#define ${NAME}_DETERMINISTIC 1 /* the mean action: no exploration noise is added */

#define ${NAME}_INPUTS ${network.inputs}
#define ${NAME}_OUTPUTS ${network.outputs}
/* Commands from ${NAME}_forward_q are integers in units of 2^-${NAME}_FRACTION_BITS ${unit}. */
#define ${NAME}_FRACTION_BITS ${network.fraction_bits}
/* An input at the edge of its range is +-2^30. */
#define ${NAME}_INPUT_ONE (INT32_C(1) << 30)

/*
 * Inputs, in this order, each within its declared range:
{% for name, limit, unit in zip(network.box.layout.labels, network.box.ranges, network.box.units) %}
 * ${"%3d  %-17s" % (loop.index0, name)} +-${limit | number} ${unit}
{% endfor %}
 */

/* What was wrong with the inputs: bit i is input i${', bit 31 any from there on' if network.inputs > 32 else ''}. Zero and zero is a good status. */
typedef struct {
  uint32_t clipped; /* outside its range, or infinite: taken as the edge of the range */
  uint32_t nan;     /* not a number: taken as zero */
} ${name}_status;

typedef enum {
  ${NAME}_SCALAR = 0,
  ${NAME}_NEON = 1 /* the same bits; falls back to scalar where it was not compiled in */
} ${name}_kernel;

/*
 * The NEON kernel is compiled in for an ARM target whose flags allow NEON, and there it is the
 * default. With -D${NAME}_WITH_NEON=1 GCC compiles it in whatever the flags say (a stock Paparazzi
 * build says -mfpu=vfp): then the caller asks the kernel, by getauxval(AT_HWCAP), before it passes
 * ${NAME}_NEON to one of the functions below.
 */
#if defined(__ARM_NEON) || defined(__ARM_NEON__)
#define ${NAME}_HAS_NEON 1
#define ${NAME}_DEFAULT_KERNEL ${NAME}_NEON
#else
#if defined(${NAME}_WITH_NEON) && defined(__arm__) && defined(__GNUC__) && !defined(__clang__)
#define ${NAME}_HAS_NEON 1
#else
#define ${NAME}_HAS_NEON 0
#endif
#define ${NAME}_DEFAULT_KERNEL ${NAME}_SCALAR
#endif

/* The bits of one float of range +-2^exponent to an integer of which the range is +-2^30. exponent
 * is -96 to 96. The two flags are 1 or 0. */
int32_t ${name}_quantize_one(uint32_t bits, int32_t exponent, uint32_t *clipped, uint32_t *nan);

/* Floats to integers: truncated to the grid of 2^-30 of the range. Total: defined for any bits. */
${name}_status ${name}_quantize(const float x[${NAME}_INPUTS], int32_t q[${NAME}_INPUTS]);

/* Integer inputs to commands within ${limits[0] | join(", ")} .. ${limits[1] | join(", ")} ${unit}. Total: inputs beyond
 * +-${NAME}_INPUT_ONE are taken as the edge. */
void ${name}_forward_q(const int32_t q[${NAME}_INPUTS], int32_t command[${NAME}_OUTPUTS]);
void ${name}_forward_q_with(${name}_kernel kernel, const int32_t q[${NAME}_INPUTS],
                           int32_t command[${NAME}_OUTPUTS]);

/* Floats to commands, ${"rpm, to the nearest" if rpm else "p, q, r in rad/s and specific thrust in m/s^2"}. */
${name}_status ${name}_forward(const float x[${NAME}_INPUTS], ${command_type} command[${NAME}_OUTPUTS]);
${name}_status ${name}_forward_with(${name}_kernel kernel, const float x[${NAME}_INPUTS],
                                  ${command_type} command[${NAME}_OUTPUTS]);

/* Commands from integers of 2^-${NAME}_FRACTION_BITS ${unit} to what the forward functions give. */
void ${name}_command(const int32_t q[${NAME}_OUTPUTS], ${command_type} command[${NAME}_OUTPUTS]);

/* As ${name}_forward_q_with, and returns a digest of every accumulator on the way. */
uint32_t ${name}_forward_traced(${name}_kernel kernel, const int32_t q[${NAME}_INPUTS],
                               int32_t command[${NAME}_OUTPUTS]);

/*
 * For start-up: the hash of the tables, a probe of every weight in every layer, and ${test.inputs | length} whole
 * inferences (corners of the input box, flown observations, random ones) against what the converter
 * computed. Returns the number of mismatches, out of ${NAME}_SELF_TESTS. Do not arm unless it is 0.
 */
#define ${NAME}_SELF_TESTS ${test.inputs | length + layers | length + 2}
uint32_t ${name}_self_test(void);
uint32_t ${name}_self_test_with(${name}_kernel kernel);

#ifdef __cplusplus
}
#endif

#endif /* ${NAME}_H */
