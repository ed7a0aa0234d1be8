/*
 * ${name}_battery: the highest propeller speed that the battery permits, estimated on board.
 *
${origin.lines | comment}
 *
 * While commands are at the limit, they are compared with the speeds that the motors reach. No
 * voltage is needed. Integer arithmetic, the same bits on every processor; no number can overflow it.
 */
#ifndef ${NAME}_BATTERY_H
#define ${NAME}_BATTERY_H

#include "${name}.h"

#ifdef __cplusplus
extern "C" {
#endif

#define ${NAME}_BATTERY_RATE ${sample_rate}F /* Hz: call the update that often */

/* What is known at one sample. In brackets: the declared range; outside it is taken as the edge.
 * 1 front-left, 2 front-right, 3 rear-right, 4 rear-left. */
typedef struct {
  float rpm[4];     /* measured speeds (+-${(2.0 ** battery.exponent) | number}) */
  float command[4]; /* commanded speeds since the sample before (+-${(2.0 ** battery.exponent) | number}) */
} ${name}_battery_sample;

/* The memory of the estimator. The caller owns it; all zero, or reset, before the first update. */
typedef struct {
  int64_t speed[4];
  int64_t expected[4];
  int64_t limited[4];
  int64_t highest;
  uint32_t started;
} ${name}_battery;

/* Which of the eight numbers, in the order of the structure, were clipped or not numbers. */
typedef ${name}_status ${name}_battery_status;

/* Forget everything: with another battery, or after a pause in the updates. */
void ${name}_battery_reset(${name}_battery *battery);

/* One sample. The first one after a reset takes the present speeds as steady, and gives the estimate
 * for the middle of the charges of the training. Always within ${(battery.lowest * battery.unit) | number} .. ${(battery.highest * battery.unit) | number} rpm. */
${name}_battery_status ${name}_battery_update(${name}_battery *battery,
                                            const ${name}_battery_sample *sample,
                                            float *highest_rpm);

/* For start-up: a run of ${NAME}_BATTERY_SELF_TESTS samples against what the converter computed.
 * Returns the number of mismatches. */
#define ${NAME}_BATTERY_SELF_TESTS ${battery_test.digests | length}
uint32_t ${name}_battery_self_test(void);

#ifdef __cplusplus
}
#endif

#endif /* ${NAME}_BATTERY_H */
