/*
 * ${name}_race: from the vehicle's state to commands, round a track of ${race.gates} gates.
 *
${origin.lines | comment}
 *
 * World north-east-down, body forward-right-down, SI units, Euler angles in rad. The floats of the
 * state become integers; everything after that is integer arithmetic, the same bits everywhere.
 */
#ifndef ${NAME}_RACE_H
#define ${NAME}_RACE_H

#include "${name}.h"

#ifdef __cplusplus
extern "C" {
#endif

#define ${NAME}_GATES ${race.gates}
#define ${NAME}_STATE_SIZE ${race.state_size}

/* What the autopilot knows, as floats. In brackets: the declared range. */
typedef struct {
{% for field in race.fields %}
  float ${field.name}${"[%d]" % field.exponents | length if field.exponents | length > 1 else ""}; /* ${field.note} (${field.ranges_text}) */
{% endfor %}
} ${name}_state;

/* What was wrong. All zero is a good status. */
typedef struct {
  uint32_t clipped; /* bit i: number i of the state is outside its range */
  uint32_t nan;     /* bit i: number i of the state is not a number, taken as zero */
  uint32_t outside; /* bit i: input i of the network is outside its range${'; bit 31: any from there on' if network.inputs > 32 else ''} */
} ${name}_race_status;

typedef enum {
  ${NAME}_NO_EVENT = 0,
  ${NAME}_GATE_PASSED = 1, /* through the opening: the next gate is the target now */
  ${NAME}_GATE_MISSED = 2  /* through the gate's plane but not the opening; the target stays */
} ${name}_event;

{% if race.history %}
/* Earlier states as integers, which the inputs of the history are computed from, seen from the
 * present gate. A start fills it with the first state; then every observation adds one. So observe
 * exactly once in ${race.time_step | number} s, as in training. */
#define ${NAME}_HISTORY ${race.history}
typedef struct {
  int32_t state[${NAME}_HISTORY][${NAME}_STATE_SIZE];
  uint32_t next;   /* row of the next state */
  uint32_t filled; /* 0 before the first one */
} ${name}_history;

void ${name}_history_begin(${name}_history *history);

{% endif %}
/* One drone in its race. The caller owns it. */
typedef struct {
  int32_t previous[3]; /* position at the last update */
  uint32_t target;     /* gate to pass next, 0 .. ${NAME}_GATES - 1 */
  uint32_t passed;     /* gates passed since the start */
  uint32_t missed;     /* gates missed since the start */
{% if race.history %}
  ${name}_history history;
{% endif %}
} ${name}_race;

/* Begin at a position, with the first target. */
void ${name}_race_start(${name}_race *race, const float position[3], uint32_t target);

/* Tell the race where the drone is now, at every step. A position that is not finite is ignored. */
${name}_event ${name}_race_update(${name}_race *race, const float position[3]);

/* The network's inputs, seen from the gate target. */
${name}_race_status ${name}_observe(${name ~ "_history *history, " if race.history else ""}const ${name}_state *state, uint32_t target,
                                  int32_t q[${NAME}_INPUTS]);

/* All in one, at every step: update, observe, infer. event may be 0. */
${name}_race_status ${name}_race_step(${name}_race *race, ${name}_kernel kernel,
                                    const ${name}_state *state,
                                    ${command_type} command[${NAME}_OUTPUTS], ${name}_event *event);

/* For start-up: states and what the converter computed for them. Returns the number of mismatches,
 * out of ${NAME}_RACE_SELF_TESTS. */
#define ${NAME}_RACE_SELF_TESTS ${race_test.states | length + (1 if race.history else 0)}
uint32_t ${name}_race_self_test(void);

#ifdef __cplusplus
}
#endif

#endif /* ${NAME}_RACE_H */
