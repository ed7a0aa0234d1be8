/* Batches for the checks: many vectors in one call. Not for flight. */
#include "${name}.h"
#include "${name}_race.h"
{% if estimator %}
#include "${name}_estimator.h"
{% endif %}
{% if battery %}
#include "${name}_battery.h"
{% endif %}
void harness_command(const float *x, uint32_t kernel, ${command_type} *out, uint32_t count);

/* Row: commands, trace, clipped, NaN. */
void harness_infer(const float *x, uint32_t kernel, int32_t *out, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    int32_t q[${NAME}_INPUTS];
    const ${name}_status status = ${name}_quantize(x, q);
    out[4] = (int32_t)${name}_forward_traced((${name}_kernel)kernel, q, out);
    out[5] = (int32_t)status.clipped;
    out[6] = (int32_t)status.nan;
    x += ${NAME}_INPUTS;
    out += 7;
  }
}

void harness_command(const float *x, uint32_t kernel, ${command_type} *out, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    (void)${name}_forward_with((${name}_kernel)kernel, x, out);
    x += ${NAME}_INPUTS;
    out += 4;
  }
}

/* Row: network inputs, clipped, NaN, outside. */
void harness_observe(const float *states, const uint32_t *targets, int32_t *out, uint32_t count) {
{% if race.history %}
  ${name}_history history;
  ${name}_history_begin(&history);
{% endif %}
  for (uint32_t i = 0U; i < count; ++i) {
    const ${name}_race_status status =
        ${name}_observe(${"&history, " if race.history else ""}(const ${name}_state *)states, targets[i], out);
    out[${NAME}_INPUTS] = (int32_t)status.clipped;
    out[${NAME}_INPUTS + 1] = (int32_t)status.nan;
    out[${NAME}_INPUTS + 2] = (int32_t)status.outside;
    states += ${NAME}_STATE_SIZE;
    out += ${NAME}_INPUTS + 3;
  }
}

/* Row: the event and the target after it, along one trajectory. */
void harness_events(const float *positions, uint32_t target, uint32_t *out, uint32_t count) {
  ${name}_race race;
  ${name}_race_start(&race, positions, target);
  for (uint32_t i = 0U; i < count; ++i) {
    out[0] = (uint32_t)${name}_race_update(&race, positions);
    out[1] = race.target;
    positions += 3;
    out += 2;
  }
}
{% if estimator %}

void harness_estimate(const float *measurements, float *out, uint32_t count) {
  ${name}_estimator estimator = {{0}, {0}, 0U};
  for (uint32_t i = 0U; i < count; ++i) {
    (void)${name}_estimator_update(&estimator, (const ${name}_measurement *)measurements, out,
                                  out + 3);
    measurements += 13;
    out += 6;
  }
}
{% endif %}
{% if battery %}

void harness_battery(const float *samples, float *out, uint32_t count) {
  ${name}_battery battery;
  ${name}_battery_reset(&battery);
  for (uint32_t i = 0U; i < count; ++i) {
    (void)${name}_battery_update(&battery, (const ${name}_battery_sample *)samples, out);
    samples += 8;
    ++out;
  }
}
{% endif %}
#ifdef HARNESS_MAIN
/* A step on board with any numbers at all as the state and as what is measured. */
static void harness_step(uint32_t kernel, const float *x) {
  static ${name}_race race;
  ${command_type} command[${NAME}_OUTPUTS];
  ${name}_event event;
{% if estimator %}
  static ${name}_estimator estimator;
  float moment[3];
  float force[3];
  (void)${name}_estimator_update(&estimator, (const ${name}_measurement *)x, moment, force);
{% endif %}
{% if battery %}
  static ${name}_battery battery;
  float highest_rpm;
  (void)${name}_battery_update(&battery, (const ${name}_battery_sample *)x, &highest_rpm);
{% endif %}
  (void)${name}_race_step(&race, (${name}_kernel)kernel, (const ${name}_state *)x, command, &event);
  if (event != ${NAME}_NO_EVENT) {
    ${name}_race_start(&race, x, race.target + 1U);
  }
}

/* Reads vectors from one file and writes rows to another. */
#include <stdio.h>

int main(int argc, char **argv) {
  static float x[${NAME}_INPUTS];
  static int32_t row[7];
  if (argc != 4) {
    return 2;
  }
  FILE *const in = fopen(argv[1], "rb");
  FILE *const out = fopen(argv[2], "wb");
  const uint32_t kernel = (argv[3][0] == 'n') ? 1U : 0U;
  if ((in == 0) || (out == 0)) {
    return 2;
  }
  while (fread(x, sizeof(x), 1, in) == 1) {
    harness_infer(x, kernel, row, 1U);
    harness_step(kernel, x);
    if (fwrite(row, sizeof(row), 1, out) != 1) {
      return 2;
    }
  }
  (void)fclose(in);
  if (fclose(out) != 0) {
    return 2;
  }
  const uint32_t wrong = ${name}_self_test_with((${name}_kernel)kernel) + ${name}_race_self_test()${" + " ~ name ~ "_estimator_self_test()" if estimator else ""}${" + " ~ name ~ "_battery_self_test()" if battery else ""};
  return (wrong != 0U) ? 1 : 0;
}
#endif
