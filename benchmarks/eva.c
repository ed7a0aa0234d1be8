/* What Frama-C analyzes: a pilot that loads words and then is called with any state, any time and any
 * memory of the race and the estimators; and the network with any integers. See eva.py. */
#include "__fc_builtin.h"
#include "qj_load.c"
#include "qj_pilot.h"
#include "words.h"

static float any_float(void) {
  union {
    float value;
    unsigned bits;
  } pun;
  pun.bits = Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU);
  return pun.value;
}
static uint32_t any_unsigned(void) { return Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU); }
static int32_t any_integer(void) { return Frama_C_interval(-2147483647 - 1, 2147483647); }
static int64_t any_long(int64_t low, int64_t high) {
  return Frama_C_long_long_interval(low, high);
}

static qj_pilot pilot;

/* The words, by the loader itself, or only where the tables are: its self-tests take long. */
static uint32_t load(void) {
  qj_policy *const policy = &pilot.policy;
#if WHOLE_LOADER
  if (qj_load(policy, words, sizeof(words)) != QJ_OK) { return 0U; }
#else
  read_header(policy, words);
  const qj_error error = find_tables(policy, words, sizeof(words) / 4U - 1U);
  policy->position = POSITION;
  /*@ assert loaded: error == QJ_OK; */
#endif
  return 1U;
}

/* The memory of the disturbances is within bounds that every call keeps (asserted below); that of the
 * highest rpm is by the proof of quadjax.export.battery_tables. */
static void remember_anything(void) {
  for (uint32_t i = 0U; i < 3U; ++i) { pilot.race.previous[i] = any_integer(); }
  for (uint32_t i = 0U; i < 6U; ++i) {
    pilot.estimator.s1[i] = any_long(-MEMORY, MEMORY);
    pilot.estimator.s2[i] = any_long(-MEMORY / 2, MEMORY / 2);
  }
  for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
    pilot.command[i] = any_float();
    pilot.battery.speed[i] = any_long(-(INT64_C(1) << 40), INT64_C(1) << 40);
    pilot.battery.expected[i] = any_long(-(INT64_C(1) << 40), INT64_C(1) << 40);
    pilot.battery.limited[i] = any_long(0, INT64_C(1) << 40);
  }
  pilot.battery.highest = any_long(0, INT64_C(1) << 40);
  pilot.battery.started = any_unsigned();
  pilot.estimator.started = any_unsigned();
  pilot.race.placed = any_unsigned();
  pilot.race.target = any_unsigned();
  pilot.race.passed = any_unsigned();
  pilot.race.missed = any_unsigned();
  pilot.usable = 1U;
  pilot.racing = any_unsigned();
  pilot.every_call = any_unsigned();
  pilot.own_estimator = ESTIMATOR;
  pilot.gives = 0xFFFFFFFFU;
  pilot.due_us = any_unsigned();
  pilot.step_us = any_unsigned();
  pilot.state_us = any_unsigned();
  pilot.lost = any_unsigned();
  pilot.lost_us = any_unsigned();
}

void eva_main(void);
void eva_main(void) {
  const qj_policy *const policy = &pilot.policy;
  qj_vehicle vehicle;
  float command[QJ_COMMANDS];
  float *const numbers = (float *)&vehicle;
  if (load() == 0U) { return; }
  remember_anything();
  for (uint32_t i = 1U; i < sizeof(vehicle) / 4U; ++i) { numbers[i] = any_float(); }
  vehicle.time_us = any_unsigned();
  if (Frama_C_interval(0, 1) != 0) { qj_pilot_wait(&pilot, &vehicle); }
  (void)qj_pilot_step(&pilot, any_unsigned(), &vehicle, command);
  for (uint32_t i = 0U; i < 6U; ++i) {
    /*@ assert bounded: -MEMORY <= pilot.estimator.s1[i] <= MEMORY; */
    /*@ assert bounded: -MEMORY / 2 <= pilot.estimator.s2[i] <= MEMORY / 2; */
  }
  int32_t q[QJ_MAX_WIDTH];
  int32_t out[QJ_COMMANDS];
  for (uint32_t i = 0U; i < policy->inputs; ++i) { q[i] = any_integer(); }
  qj_forward(policy, q, out, 0);
  for (int i = 0; i < QJ_COMMANDS; ++i) {
    /*@ assert limits: policy->low[i] <= out[i] <= policy->high[i]; */
  }
}
