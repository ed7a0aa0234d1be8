{% import "helpers.c" as c %}
{# The inputs of a field, from the integers of a state in the array ``from``. #}
{% macro observed(field, from) %}
{% set i = field.index %}
{% set s = field.sources[0] %}
{% if field.kind == "position" %}
  const int64_t x = (int64_t)${from}[${s}] - g->position[0];
  const int64_t y = (int64_t)${from}[${s + 1}] - g->position[1];
  const int64_t z = (int64_t)${from}[${s + 2}] - g->position[2];
  const int32_t metres = Q30 - POSITION_EXPONENT + INPUT_POSITION_EXPONENT;
  q[${i}] = hold(round_shift(along(g, x, y), metres), outside, ${i}U);
  q[${i + 1}] = hold(round_shift(across(g, x, y), metres), outside, ${i + 1}U);
  q[${i + 2}] = hold(round_shift(z * (INT64_C(1) << Q30), metres), outside, ${i + 2}U);
{% elif field.kind == "velocity" %}
  const int32_t speed = Q30 - VELOCITY_EXPONENT + INPUT_VELOCITY_EXPONENT;
  q[${i}] = hold(round_shift(along(g, ${from}[${s}], ${from}[${s + 1}]), speed), outside, ${i}U);
  q[${i + 1}] = hold(round_shift(across(g, ${from}[${s}], ${from}[${s + 1}]), speed), outside, ${i + 1}U);
  q[${i + 2}] = hold(round_shift(${from}[${s + 2}] * (INT64_C(1) << Q30), speed), outside, ${i + 2}U);
{% elif field.kind == "attitude" %}
  q[${i}] = ${from}[${s}];
  q[${i + 1}] = ${from}[${s + 1}];
  const int64_t yaw = ${from}[${s + 2}] * (INT64_C(1) << YAW_EXPONENT) - g->yaw;
  q[${i + 2}] = hold(round_shift(wrap(yaw), INPUT_YAW_EXPONENT), outside, ${i + 2}U);
{% elif field.kind == "rotation" %}
  const int64_t qw = ${from}[${s}];
  const int64_t qx = ${from}[${s + 1}];
  const int64_t qy = ${from}[${s + 2}];
  const int64_t qz = ${from}[${s + 3}];
  const int64_t axis[2][3] = { /* the body's x and z axes, world, Q30 */
      {element(QUATERNION_ONE - 2 * (qy * qy + qz * qz)), element(2 * (qx * qy + qw * qz)),
       element(2 * (qx * qz - qw * qy))},
      {element(2 * (qx * qz + qw * qy)), element(2 * (qy * qz - qw * qx)),
       element(QUATERNION_ONE - 2 * (qx * qx + qy * qy))}};
  const int32_t unit = Q30 + ${race.box.exponent["rotation"]};
  for (uint32_t k = 0U; k < 2U; ++k) {
    const int64_t *const a = axis[k];
    int32_t *const to = &q[${i}U + 3U * k];
    to[0] = hold(round_shift(along(g, a[0], a[1]), unit), outside, ${i}U + 3U * k);
    to[1] = hold(round_shift(across(g, a[0], a[1]), unit), outside, ${i + 1}U + 3U * k);
    to[2] = hold(round_shift(a[2] * (INT64_C(1) << Q30), unit), outside, ${i + 2}U + 3U * k);
  }
{% elif field.kind == "scaled" %}
{% for number, rescale in zip(field.sources, field.rescales) %}
{% set k = i + loop.index0 %}
{% if rescale %}
  q[${k}] = hold(rescale(${from}[${number}], ${rescale.middle}, ${rescale.factor}, ${rescale.shift}), outside, ${k}U);
{% else %}
  q[${k}] = 0; /* the policy was trained without it */
{% endif %}
{% endfor %}
{% else %}
{% for number in field.sources %}
  q[${i + loop.index0}] = ${from if field.kind == "copy" else "g->next"}[${number}];
{% endfor %}
{% endif %}
{% endmacro %}
/*
 * ${name}_race: see ${name}_race.h.
 *
${origin.lines | comment}
 *
 * A number of the state with the range +-2^e is an integer q = x 2^(30 - e). Sums are int64_t: of
 * two coordinates below 2^31 times a sine and a cosine of at most 2^30, so below 2^63.
 */
#include "${name}_race.h"

#include <stdbool.h>

enum {
  POSITION_EXPONENT = ${race.exponent("position")},
  VELOCITY_EXPONENT = ${race.exponent("velocity")},
  /* Network inputs have their own ranges. */
  INPUT_POSITION_EXPONENT = ${race.box.exponent["position"]},
  INPUT_VELOCITY_EXPONENT = ${race.box.exponent["velocity"]},
  INPUT_YAW_EXPONENT = ${race.box.exponent["attitude"]},
  YAW_EXPONENT = ${yaw_exponent},
  Q30 = 30,
  SELF_TESTS = ${race_test.states | length}
};

/* 2^32 / (2 pi): a yaw in Q24 times this is in turns of 2^56. */
#define TURNS_PER_UNIT INT64_C(${turns_per_unit})
#define TURN_SHIFT 56
/* 2 pi in Q30 */
#define TWO_PI INT64_C(${two_pi})
{% if "matrix" in race.helpers %}
/* A quaternion has the range +-2: products are in Q58, elements of the matrix are held to +-2. */
#define QUATERNION_ONE (INT64_C(1) << 58)
#define MATRIX_SHIFT 28
#define MATRIX_LIMIT (INT64_C(1) << 31)
{% endif %}

/* ---- the track ---------------------------------------------------------------------------------- */

typedef struct {
  int32_t position[3];  /* centre, units of 2^(POSITION_EXPONENT - 30) m */
  int32_t cosine;       /* of the yaw, Q30 */
  int32_t sine;         /* of the yaw, Q30 */
  int32_t half_width;   /* of the opening, units of the position */
  int32_t half_height;  /* of the opening, units of the position */
  int64_t yaw;          /* rad, Q30 */
{% if race.axes is not none %}
  int32_t axis[3][3];   /* directions through the gate, to its right and down, world, Q30 */
{% endif %}
{% if race.circle is not none %}
  bool is_round;        /* the opening is a circle of radius half_width */
{% endif %}
{% if race.next_gate.shape[1] %}
  int32_t next[${race.next_gate.shape[1]}];      /* inputs: the next gate's position and yaw from this one */
{% endif %}
} gate;

{% macro opening(g) %}
{%- if race.axes is not none %}, {{${race.axes[g][0] | join(", ")}}, {${race.axes[g][1] | join(", ")}}, {${race.axes[g][2] | join(", ")}}}{% endif -%}
{%- if race.circle is not none %}, ${"true" if race.circle[g] else "false"}{% endif -%}
{% endmacro %}
static const gate track[${NAME}_GATES] = {
{% for g in range(race.gates) %}
    {{${race.gate_position[g] | join(", ")}}, ${race.gate_cos[g]}, ${race.gate_sin[g]}, ${race.half_size[g] | join(", ")}, ${race.gate_yaw[g] | int64}${opening(g)}${"," if race.next_gate.shape[1] else ("}" if loop.last else "},")}
{% if race.next_gate.shape[1] %}
     {${race.next_gate[g] | join(", ")}}}${"" if loop.last else ","}
{% endif %}
{% endfor %}
};

/* ---- integers ----------------------------------------------------------------------------------- */

static const int8_t state_exponent[${NAME}_STATE_SIZE] = {${race.exponents | join(", ")}};

static int32_t quantize(float value, int32_t exponent, uint32_t *clipped, uint32_t *nan) {
  union {
    float value;
    uint32_t bits;
  } pun;
  pun.value = value;
  return ${name}_quantize_one(pun.bits, exponent, clipped, nan);
}

{% if "round_shift" in race.helpers %}
/* value / 2^shift to the nearest; a shift below one is one to the left. */
${c.round_shift()}
{% endif %}
{% if "hold" in race.helpers %}
/* Into the network's range, and whether it was outside. */
static int32_t hold(int64_t value, uint32_t *outside, uint32_t input) {
  const int64_t held = (value > ${NAME}_INPUT_ONE)
                           ? ${NAME}_INPUT_ONE
                           : ((value < -${NAME}_INPUT_ONE) ? -${NAME}_INPUT_ONE : value);
  *outside |= ((held != value) ? 1U : 0U) << ${'input' if network.inputs <= 32 else '((input < 31U) ? input : 31U)'};
  return (int32_t)held;
}

{% endif %}
/* x through the gate, y to its right; the result before its shift, Q30 times the units of x. */
{% if "along" in race.helpers %}
static int64_t along(const gate *g, int64_t x, int64_t y) { return g->cosine * x + g->sine * y; }
{% endif %}
{% if "across" in race.helpers %}
static int64_t across(const gate *g, int64_t x, int64_t y) { return g->cosine * y - g->sine * x; }
{% endif %}

{% if "wrap" in race.helpers %}
/* Within half a turn, by one multiplication and no loop. */
static int64_t wrap(int64_t yaw_q30) {
  const int64_t turns = ((yaw_q30 >> YAW_EXPONENT) * TURNS_PER_UNIT +
                         (INT64_C(1) << (TURN_SHIFT - 1))) >> TURN_SHIFT;
  return yaw_q30 - turns * TWO_PI;
}

{% endif %}
{% if "matrix" in race.helpers %}
/* An element of the rotation matrix: a sum of products of the quaternion in Q58, to Q30. */
static int64_t element(int64_t sum) {
  const int64_t value = round_shift(sum, MATRIX_SHIFT);
  return (value > MATRIX_LIMIT) ? MATRIX_LIMIT : ((value < -MATRIX_LIMIT) ? -MATRIX_LIMIT : value);
}

{% endif %}
{% if "rescale" in race.helpers %}
/* (value - middle) factor / 2^shift: what is scaled to [-1, 1]. */
static int64_t rescale(int32_t value, int32_t middle, int32_t factor, int32_t shift) {
  return round_shift(((int64_t)value - middle) * factor, shift);
}

{% endif %}
{% if race.history %}
/* ---- the history -------------------------------------------------------------------------------- */

void ${name}_history_begin(${name}_history *history) {
  history->next = 0U;
  history->filled = 0U;
}

/* Room for the state, which is all of the history at a start. */
static void make_room(${name}_history *history, const int32_t s[${NAME}_STATE_SIZE]) {
  history->next = (history->next < ${NAME}_HISTORY) ? history->next : 0U;
  if (history->filled == 0U) {
    for (uint32_t step = 0U; step < ${NAME}_HISTORY; ++step) {
      for (uint32_t i = 0U; i < ${NAME}_STATE_SIZE; ++i) {
        history->state[step][i] = s[i];
      }
    }
  }
  history->filled = 1U;
}

static void remember(${name}_history *history, const int32_t s[${NAME}_STATE_SIZE]) {
  for (uint32_t i = 0U; i < ${NAME}_STATE_SIZE; ++i) {
    history->state[history->next][i] = s[i];
  }
  history->next = (history->next + 1U < ${NAME}_HISTORY) ? history->next + 1U : 0U;
}

/* The state of some steps before the present one, at most ${NAME}_HISTORY. */
static const int32_t *recall(const ${name}_history *history, uint32_t steps) {
  const uint32_t row = history->next + ${NAME}_HISTORY - steps;
  return history->state[(row < ${NAME}_HISTORY) ? row : row - ${NAME}_HISTORY];
}

{% endif %}
/* ---- the observation ---------------------------------------------------------------------------- */

static ${name}_race_status quantize_state(const ${name}_state *state,
                                         int32_t s[${NAME}_STATE_SIZE]) {
  ${name}_race_status status = {0U, 0U, 0U};
  const float x[${NAME}_STATE_SIZE] = {
${state_values | wrapped}};
${c.quantize_all("s", NAME ~ "_STATE_SIZE", "quantize(x[i], state_exponent[i]", race.state_size)}
{% if race.history %}
/* Inputs of earlier states, seen from the present gate. */
static void observe_past(const ${name}_history *history, const gate *g, uint32_t *outside,
                         int32_t q[${NAME}_INPUTS]) {
{% if "hold" not in race.helpers %}
  (void)outside;
{% endif %}
{% if "gate" not in race.helpers %}
  (void)g;
{% endif %}
{% for lag, fields in race.inputs | selectattr("lag") | groupby("lag") %}
  {
    const int32_t *const past = recall(history, ${lag}U);
{% for field in fields %}
${observed(field, "past") | indent(2, first=True)}{% endfor %}
  }
{% endfor %}
}

{% endif %}
${name}_race_status ${name}_observe(${name ~ "_history *history, " if race.history else ""}const ${name}_state *state, uint32_t target,
                                  int32_t q[${NAME}_INPUTS]) {
  int32_t s[${NAME}_STATE_SIZE];
  ${name}_race_status status = quantize_state(state, s);
{% if race.history %}
  make_room(history, s);
{% endif %}
  const gate *const g = &track[(target < ${NAME}_GATES) ? target : 0U];
  uint32_t *const outside = &status.outside;
{% if "hold" not in race.helpers %}
  (void)outside;
{% endif %}
{% if "gate" not in race.helpers %}
  (void)g;
{% endif %}
{% for field in race.inputs if not field.lag %}
${observed(field, "s")}{% endfor %}
{% if race.history %}
  observe_past(history, g, outside, q);
  remember(history, s);
{% endif %}
  return status;
}

/* ---- the race ----------------------------------------------------------------------------------- */

static uint32_t quantize_position(const float position[3], int32_t p[3]) {
  uint32_t unusable = 0U;
  for (uint32_t i = 0U; i < 3U; ++i) {
    uint32_t clipped;
    uint32_t nan;
    p[i] = quantize(position[i], POSITION_EXPONENT, &clipped, &nan);
    unusable |= clipped | nan;
  }
  return unusable;
}

void ${name}_race_start(${name}_race *race, const float position[3], uint32_t target) {
  (void)quantize_position(position, race->previous);
  race->target = (target < ${NAME}_GATES) ? target : 0U;
  race->passed = 0U;
  race->missed = 0U;
{% if race.history %}
  ${name}_history_begin(&race->history);
{% endif %}
}

static int64_t magnitude(int64_t value) { return (value < 0) ? -value : value; }

{% if race.axes is not none %}
/* A vector along an axis of length one, Q30 times its units: three products below 2^61. */
static int64_t on_axis(const int32_t axis[3], int64_t x, int64_t y, int64_t z) {
  return axis[0] * x + axis[1] * y + axis[2] * z;
}

{% endif %}
{% if race.world_box %}
/* Whether a point, relative to the gate's centre, is within the opening: along the world's axes. */
static bool is_inside(const gate *g, int64_t x, int64_t y, int64_t z) {
  return (magnitude(x) < g->half_width) && (magnitude(y) < g->half_width) &&
         (magnitude(z) < g->half_height);
}
{% else %}
/* Whether a point, relative to the gate's centre, is within the opening: along the gate's axes. */
static bool is_inside(const gate *g, int64_t x, int64_t y, int64_t z) {
{% if race.axes is none and race.circle is none %}
  return (magnitude(round_shift(across(g, x, y), Q30)) <= g->half_width) &&
         (magnitude(z) <= g->half_height);
{% else %}
{% if race.axes is none %}
  const int64_t right = magnitude(round_shift(across(g, x, y), Q30));
  const int64_t down = magnitude(z);
{% else %}
  const int64_t right = magnitude(round_shift(on_axis(g->axis[1], x, y, z), Q30));
  const int64_t down = magnitude(round_shift(on_axis(g->axis[2], x, y, z), Q30));
{% endif %}
  const bool inside = (right <= g->half_width) && (down <= g->half_height);
{% if race.circle is none %}
  return inside;
{% else %}
  if (!inside || !g->is_round) { /* inside: both are below 2^31, and their squares below 2^62 */
    return inside;
  }
  return right * right + down * down <= (int64_t)g->half_width * g->half_width;
{% endif %}
{% endif %}
}
{% endif %}

/* A gate is crossed when the position goes from behind its plane to in front of it. */
static ${name}_event crossing(const gate *g, const int32_t before[3], const int32_t after[3]) {
  const int64_t x = (int64_t)after[0] - g->position[0];
  const int64_t y = (int64_t)after[1] - g->position[1];
  const int64_t z = (int64_t)after[2] - g->position[2];
{% if race.axes is none %}
  const int64_t was = along(g, (int64_t)before[0] - g->position[0],
                            (int64_t)before[1] - g->position[1]);
  if ((was >= 0) || (along(g, x, y) < 0)) {
{% else %}
  const int64_t was = on_axis(g->axis[0], (int64_t)before[0] - g->position[0],
                              (int64_t)before[1] - g->position[1],
                              (int64_t)before[2] - g->position[2]);
  if ((was >= 0) || (on_axis(g->axis[0], x, y, z) < 0)) {
{% endif %}
    return ${NAME}_NO_EVENT;
  }
  return is_inside(g, x, y, z) ? ${NAME}_GATE_PASSED : ${NAME}_GATE_MISSED;
}

${name}_event ${name}_race_update(${name}_race *race, const float position[3]) {
  int32_t now[3];
  race->target = (race->target < ${NAME}_GATES) ? race->target : 0U;
  if (quantize_position(position, now) != 0U) {
    return ${NAME}_NO_EVENT;
  }
  const ${name}_event event = crossing(&track[race->target], race->previous, now);
  if (event == ${NAME}_GATE_PASSED) {
    race->target = (race->target + 1U < ${NAME}_GATES) ? race->target + 1U : 0U;
    ++race->passed;
  } else if (event == ${NAME}_GATE_MISSED) {
    ++race->missed;
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    race->previous[i] = now[i];
  }
  return event;
}

${name}_race_status ${name}_race_step(${name}_race *race, ${name}_kernel kernel,
                                    const ${name}_state *state,
                                    ${command_type} command[${NAME}_OUTPUTS], ${name}_event *event) {
  int32_t q[${NAME}_INPUTS];
  int32_t integers[${NAME}_OUTPUTS];
  const ${name}_event happened = ${name}_race_update(race, state->position);
  const ${name}_race_status status = ${name}_observe(${"&race->history, " if race.history else ""}state, race->target, q);
  ${name}_forward_q_with(kernel, q, integers);
  ${name}_command(integers, command);
  if (event != 0) {
    *event = happened;
  }
  return status;
}

/* ---- self-test ---------------------------------------------------------------------------------- */

/* The bits of states, the target of each, the inputs that follow and the status. */
static const uint32_t test_state[SELF_TESTS][${NAME}_STATE_SIZE] = {
${rows(race_test.states, "hex")}
};
static const ${"uint8_t" if race.gates <= 256 else "uint32_t"} test_target[SELF_TESTS] = {${race_test.targets | join(", ")}};
static const int32_t test_input[SELF_TESTS][${NAME}_INPUTS] = {
${rows(race_test.inputs, "int32")}
};
static const uint32_t test_status[SELF_TESTS][3] = {
${rows(race_test.status, "unsigned")}
};

${c.float_of("float_of")}
{% macro read_test() %}
  ${name}_state state;
  const uint32_t *const bits = test_state[number];
{% for name in race.names %}
  state.${name} = float_of(bits[${loop.index0}]);
{% endfor %}
{% endmacro %}
{% if race.history %}
static ${name}_race_status observe_test(${name}_history *history, uint32_t number,
                                       int32_t q[${NAME}_INPUTS]) {
${read_test()}  return ${name}_observe(history, &state, test_target[number], q);
}

static uint32_t state_fails(${name}_history *history, uint32_t number) {
  int32_t q[${NAME}_INPUTS];
  const ${name}_race_status status = observe_test(history, number, q);
{% else %}
static uint32_t state_fails(uint32_t number) {
  int32_t q[${NAME}_INPUTS];
${read_test()}  const ${name}_race_status status = ${name}_observe(&state, test_target[number], q);
{% endif %}
  uint32_t wrong = (status.clipped ^ test_status[number][0]) | (status.nan ^ test_status[number][1]);
  wrong |= status.outside ^ test_status[number][2];
  for (uint32_t i = 0U; i < ${NAME}_INPUTS; ++i) {
    wrong |= (uint32_t)(q[i] ^ test_input[number][i]);
  }
  return (wrong != 0U) ? 1U : 0U;
}

{% if race.history %}
/* A digest of the inputs in further rounds of the states, which go through all of the history. */
static uint32_t history_digest(${name}_history *history) {
  uint32_t digest = UINT32_C(2166136261);
  for (uint32_t step = 0U; step < ${race_test.rounds}U * SELF_TESTS; ++step) {
    int32_t q[${NAME}_INPUTS];
    (void)observe_test(history, step % SELF_TESTS, q);
    for (uint32_t i = 0U; i < ${NAME}_INPUTS; ++i) {
      digest = (digest ^ (uint32_t)q[i]) * UINT32_C(16777619);
    }
  }
  return digest;
}

{% endif %}
uint32_t ${name}_race_self_test(void) {
  uint32_t mismatches = 0U;
{% if race.history %}
  ${name}_history history;
  ${name}_history_begin(&history);
{% endif %}
  for (uint32_t number = 0U; number < SELF_TESTS; ++number) {
    mismatches += state_fails(${"&history, " if race.history else ""}number);
  }
{% if race.history %}
  mismatches += (history_digest(&history) != UINT32_C(${race_test.digest})) ? 1U : 0U;
{% endif %}
  return mismatches;
}
