{% import "helpers.c" as c %}
#include "__fc_builtin.h"
#include "${name}_race.h"
{% if estimator %}
#include "${name}_estimator.h"
{% endif %}
{% if battery %}
#include "${name}_battery.h"
{% endif %}

${c.any_float()}
static int32_t any_integer(void) { return Frama_C_interval(-2147483647 - 1, 2147483647); }
static uint32_t any_unsigned(void) { return Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU); }

static void run_network(void) {
  float x[${NAME}_INPUTS];
  int32_t q[${NAME}_INPUTS];
  int32_t command[${NAME}_OUTPUTS];
  ${command_type} out[${NAME}_OUTPUTS];
  for (int i = 0; i < ${NAME}_INPUTS; ++i) {
    q[i] = any_integer();
  }
  ${name}_forward_q(q, command);
{% for low, high in zip(network.command_low, network.command_high) %}
  /*@ assert ${low} <= command[${loop.index0}] <= ${high}; */
{% endfor %}
  ${name}_command(command, out);
{% for low, high in limits %}
  /*@ assert ${low} <= out[${loop.index0}] <= ${high}; */
{% endfor %}
  for (int i = 0; i < ${NAME}_INPUTS; ++i) {
    x[i] = any_float();
  }
  (void)${name}_quantize(x, q);
  for (int i = 0; i < ${NAME}_INPUTS; ++i) {
    /*@ assert -${NAME}_INPUT_ONE <= q[i] <= ${NAME}_INPUT_ONE; */
  }
}

/* The race from any memory of it. */
static void run_race(void) {
  ${name}_state state;
  ${name}_race race;
  int32_t q[${NAME}_INPUTS];
  ${command_type} out[${NAME}_OUTPUTS];
  ${name}_event event;
  float *const numbers = (float *)&state;
  for (int i = 0; i < ${states}; ++i) {
    numbers[i] = any_float();
  }
  ${name}_race_start(&race, state.position, any_unsigned());
  for (int i = 0; i < 3; ++i) {
    race.previous[i] = any_integer();
  }
  race.target = any_unsigned();
  race.passed = any_unsigned();
  race.missed = any_unsigned();
{% if race.history %}
  for (int step = 0; step < ${race.history}; ++step) {
    for (int i = 0; i < ${states}; ++i) {
      race.history.state[step][i] = Frama_C_interval(-${NAME}_INPUT_ONE, ${NAME}_INPUT_ONE);
    }
  }
  race.history.next = any_unsigned();
  race.history.filled = any_unsigned();
{% endif %}
  (void)${name}_observe(${"&race.history, " if race.history else ""}&state, any_unsigned(), q);
  for (int i = 0; i < ${NAME}_INPUTS; ++i) {
    /*@ assert -${NAME}_INPUT_ONE <= q[i] <= ${NAME}_INPUT_ONE; */
  }
  (void)${name}_race_step(&race, ${NAME}_SCALAR, &state, out, &event);
  /*@ assert race.target < ${NAME}_GATES; */
{% for low, high in limits %}
  /*@ assert ${low} <= out[${loop.index0}] <= ${high}; */
{% endfor %}
}
{% if estimator %}

/* A sample from any memory that the filters can have: the converter has proven their outputs to
 * stay below ${memory}. The first number of a filter's memory is its next output should all inputs
 * be zero, so below that too; the second is at most twice as much. */
static void run_estimator(void) {
  ${name}_measurement m;
  ${name}_estimator estimator;
  float moment[3];
  float force[3];
  float *const numbers = (float *)&m;
  for (int i = 0; i < 13; ++i) {
    numbers[i] = any_float();
  }
  for (int i = 0; i < 6; ++i) {
    estimator.s1[i] = Frama_C_long_long_interval(-${memory}LL, ${memory}LL);
    estimator.s2[i] = Frama_C_long_long_interval(-2LL * ${memory}LL, 2LL * ${memory}LL);
  }
  estimator.started = any_unsigned();
  (void)${name}_estimator_update(&estimator, &m, moment, force);
}
{% endif %}
{% if battery %}

/* A sample from any memory that the converter has proven the estimator to stay in, and a reset. */
static void run_battery(void) {
  ${name}_battery_sample sample;
  ${name}_battery battery;
  float highest_rpm;
  float *const numbers = (float *)&sample;
  for (int i = 0; i < 8; ++i) {
    numbers[i] = any_float();
  }
  for (int i = 0; i < 4; ++i) {
    battery.speed[i] = Frama_C_long_long_interval(-${battery_memory}LL, ${battery_memory}LL);
    battery.expected[i] = Frama_C_long_long_interval(-${battery_memory}LL, ${battery_memory}LL);
    battery.limited[i] = Frama_C_long_long_interval(0LL, ${battery_memory}LL);
  }
  battery.highest = Frama_C_long_long_interval(${battery.lowest}LL, ${battery.highest}LL);
  battery.started = any_unsigned();
  (void)${name}_battery_update(&battery, &sample, &highest_rpm);
  /*@ assert ${battery.lowest} <= battery.highest <= ${battery.highest}; */
  ${name}_battery_reset(&battery);
  (void)${name}_battery_update(&battery, &sample, &highest_rpm);
}
{% endif %}
void eva_main(void);
void eva_main(void) {
  run_network();
  run_race();
{% if estimator %}
  run_estimator();
{% endif %}
{% if battery %}
  run_battery();
{% endif %}
}
