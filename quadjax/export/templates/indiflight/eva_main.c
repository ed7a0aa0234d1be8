{% import "helpers.c" as c %}
/* INDIflight's functions for any state and any memory of the controller, after its self-tests. */
#include "__fc_builtin.h"
#include "nn_controller.c"

${c.any_float()}
static uint32_t any_unsigned(void) { return Frama_C_unsigned_int_interval(0U, 0xFFFFFFFFU); }

static void any_controller(void) {
  controller.tested = true;
  controller.racing = Frama_C_interval(0, 1) != 0;
  controller.mismatches = any_unsigned();
{% if race.box.layout.counts_steps %}
  /* A target and commands that are held between two steps are those of a step. */
  controller.calls = any_unsigned();
{% endif %}
{% if race.history %}
  /* States that were quantized, which is all that is ever stored. */
  for (int step = 0; step < ${race.history}; ++step) {
    for (int i = 0; i < ${NAME}_STATE_SIZE; ++i) {
      controller.race.history.state[step][i] = Frama_C_interval(-${NAME}_INPUT_ONE, ${NAME}_INPUT_ONE);
    }
  }
  controller.race.history.next = any_unsigned();
  controller.race.history.filled = any_unsigned();
{% endif %}
{% if race.box.layout.counts_steps %}
  controller.race.target = Frama_C_unsigned_int_interval(0U, NUM_GATES - 1U);
{% else %}
  controller.race.target = any_unsigned();
{% endif %}
  controller.race.passed = any_unsigned();
  controller.race.missed = any_unsigned();
  for (int i = 0; i < 3; ++i) {
    controller.race.previous[i] = Frama_C_interval(-2147483647 - 1, 2147483647);
  }
  for (int i = 0; i < 4; ++i) {
    controller.command[i] = ${"Frama_C_float_interval(0.0F, 1.0F)" if race.box.layout.counts_steps else "any_float()"};
  }
  controller.counters.steps = any_unsigned();
  controller.counters.nan_steps = any_unsigned();
  controller.counters.clipped_steps = any_unsigned();
  controller.counters.outside_steps = any_unsigned();
}

void eva_main(void);
void eva_main(void) {
  float world_state[16];
  float motor_cmds[4];
  for (int i = 0; i < 16; ++i) {
    world_state[i] = any_float();
  }
  any_controller();
  if (Frama_C_interval(0, 1) != 0) {
    nn_reset();
  }
  nn_control(world_state, motor_cmds);
{% for motor in range(4) %}
  /*@ assert 0.0 <= motor_cmds[${motor}] <= 1.0; */
{% endfor %}
  /*@ assert target_gate_index < NUM_GATES; */
  (void)nn_counters();
}
