{% import "helpers.c" as c %}
/* The functions of a loaded policy for any state and any memory; loading itself is checked by running
 * it. Includes qjp_load.c for its functions that find the tables. */
#include "__fc_builtin.h"
#include "qjp_load.c"
#include "words.h"
{% if pilot %}
#include "qjp_pilot.h"
{% endif %}

${c.any_float()}
static int32_t any_integer(void) { return Frama_C_interval(-2147483647 - 1, 2147483647); }
static uint32_t any_unsigned(void) { return Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU); }

static qjp_policy policy;
{% if pilot %}
static qjp_pilot pilot;
{% endif %}

static void any_race(qjp_race *race) {
  for (int i = 0; i < 3; ++i) {
    race->previous[i] = any_integer();
  }
  race->target = any_unsigned();
  race->passed = any_unsigned();
  race->missed = any_unsigned();
}

static void run_network(void) {
  int32_t q[QJP_MAX_WIDTH];
  int32_t command[QJP_COMMANDS];
  float out[QJP_COMMANDS];
  for (int i = 0; i < ${network.inputs}; ++i) {
    q[i] = any_integer();
  }
  qjp_forward(&policy, q, command, 0);
{% for low, high in zip(network.command_low, network.command_high) %}
  /*@ assert ${low} <= command[${loop.index0}] <= ${high}; */
{% endfor %}
  qjp_commands(&policy, command, out);
}

static void run_race(void) {
  float state[QJP_MAX_STATE];
  int32_t q[QJP_MAX_WIDTH];
  qjp_race race;
  for (int i = 0; i < QJP_MAX_STATE; ++i) {
    state[i] = any_float();
  }
  qjp_race_start(&policy, &race, state, any_unsigned());
  any_race(&race);
  (void)qjp_race_update(&policy, &race, state);
  /*@ assert race.target < policy.gates; */
  (void)qjp_observe(&policy, state, any_unsigned(), q);
  for (int i = 0; i < ${network.inputs}; ++i) {
    /*@ assert -QJP_INPUT_ONE <= q[i] <= QJP_INPUT_ONE; */
  }
}
{% if pilot %}

static void run_pilot(void) {
  qjp_vehicle vehicle;
  float motors[QJP_COMMANDS];
  float *const numbers = (float *)&vehicle;
  for (int i = 0; i < 20; ++i) {
    numbers[i] = any_float();
  }
  pilot.policy = policy;
  pilot.usable = 1U;
  pilot.racing = any_unsigned();
  any_race(&pilot.race);
  pilot.counters.steps = any_unsigned();
  pilot.counters.nan_steps = any_unsigned();
  pilot.counters.clipped_steps = any_unsigned();
  pilot.counters.outside_steps = any_unsigned();
  for (int i = 0; i < QJP_COMMANDS; ++i) {
    pilot.command[i] = any_float();
  }
  if (Frama_C_interval(0, 1) != 0) {
    qjp_pilot_reset(&pilot);
  }
  qjp_pilot_step(&pilot, &vehicle, motors);
{% for motor in range(4) %}
  /*@ assert 0.0 <= motors[${motor}] <= 1.0; */
{% endfor %}
}
{% endif %}

void eva_main(void);
void eva_main(void) {
  read_header(&policy, qjp_data);
  const qjp_error error = find_tables(&policy, qjp_data, sizeof(qjp_data) / 4U - QJP_HASH_WORDS);
  /*@ assert error == QJP_OK; */
  run_network();
  run_race();
{% if pilot %}
  run_pilot();
{% endif %}
}
