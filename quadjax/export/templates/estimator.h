/*
 * ${name}_estimator: external moment and specific force on board.
 *
${origin.lines | comment}
 *
 * What is measured less what the model of the vehicle explains, through a second-order Butterworth
 * low-pass of ${estimator.cutoff | number} Hz at ${sample_rate} Hz. Integer arithmetic, the same bits on every processor;
 * no measurement can overflow it.
 */
#ifndef ${NAME}_ESTIMATOR_H
#define ${NAME}_ESTIMATOR_H

#include "${name}.h"

#ifdef __cplusplus
extern "C" {
#endif

#define ${NAME}_ESTIMATOR_RATE ${sample_rate}F /* Hz: call the update that often */
#define ${NAME}_ESTIMATOR_RESIDUAL_SHA256 "${residual_hash}"

/* What is known at one sample. In brackets: the declared range; outside it is taken as the edge. */
typedef struct {
  float gyro[3];           /* p, q, r, rad/s, body (+-${(2.0 ** estimator.exponents[0]) | number}) */
  float specific_force[3]; /* accelerometer less its bias, m/s^2, body (+-${(2.0 ** estimator.exponents[3]) | number}) */
  float rpm[4];            /* 1 front-left, 2 front-right, 3 rear-right, 4 rear-left (+-${(2.0 ** estimator.exponents[6]) | number}) */
  float velocity[3];       /* m/s, body (+-${(2.0 ** estimator.exponents[10]) | number}) */
} ${name}_measurement;

/* The memory of the filters. The caller owns it; all zero before the first update. */
typedef struct {
  int64_t s1[6];
  int64_t s2[6];
  uint32_t started;
} ${name}_estimator;

/* Which of the thirteen numbers, in the order of the structure, were clipped or not numbers. */
typedef ${name}_status ${name}_estimator_status;

/* One sample. The first one after zeroing takes the present rates and rpm as steady, so that a drone
 * that is turning already does not look as if it had been struck.
 * moment: N m, body; force: specific force, m/s^2, body. */
${name}_estimator_status ${name}_estimator_update(${name}_estimator *estimator,
                                                const ${name}_measurement *measurement,
                                                float moment[3], float force[3]);

/* For start-up: a run of ${NAME}_ESTIMATOR_SELF_TESTS samples against what the converter computed.
 * Returns the number of mismatches. */
#define ${NAME}_ESTIMATOR_SELF_TESTS ${estimator_test.outputs | length}
uint32_t ${name}_estimator_self_test(void);

#ifdef __cplusplus
}
#endif

#endif /* ${NAME}_ESTIMATOR_H */
