/* Words of a .qjp file, for qjp_load.c and qjp_run.c. */
#ifndef QJP_LAYOUT_H
#define QJP_LAYOUT_H

#include "qjp.h"

enum {
  QJP_MAGIC = 0x00504A51, /* "QJP" and a zero */
  QJP_HASH_WORDS = 8,
  /* of the header */
  QJP_AT_MAGIC = 0,
  QJP_AT_VERSION = 1,
  QJP_AT_BYTES = 2,
  QJP_AT_INPUTS = 3,
  QJP_AT_OUTPUTS = 4,
  QJP_AT_LAYERS = 5,
  QJP_AT_STATE_SIZE = 6,
  QJP_AT_FIELDS = 7,
  QJP_AT_PARTS = 8,
  QJP_AT_GATES = 9,
  QJP_AT_CONSTANTS = 10,
  QJP_AT_WORLD_BOX = 11,
  QJP_AT_KIND = 12,
  QJP_AT_SHIFT = 13,
  QJP_AT_FRACTION = 14,
  QJP_AT_PERIOD = 15,
  QJP_AT_NETWORK_TESTS = 16,
  QJP_AT_RACE_TESTS = 17,
  QJP_AT_SOURCE = 18,
  QJP_AT_NAME = 26,
  QJP_AT_VEHICLE = 34,
  QJP_AT_PLACES = 38,
  QJP_AT_LOW = 42,
  QJP_AT_HIGH = 46,
  QJP_HEADER_WORDS = 50,
  /* of a layer's certificate: rows, columns, largest sum (2), largest output */
  QJP_LAYER_WORDS = 5,
  /* of a field of the state: code, first number, size */
  QJP_FIELD_WORDS = 3,
  /* of a field of the observation: kind, first input, size, exponent, name (6) */
  QJP_PART_WORDS = 10,
  /* of an input: number of the state or of the gate's constants, middle, factor, shift */
  QJP_INPUT_WORDS = 4,
  /* of a gate: position (3), axes through it, to its right and down (9), cosine and sine of its
   * yaw, half width, half height, whether it is round, yaw (2); then the constants */
  QJP_GATE_AXES = 3,
  QJP_GATE_COSINE = 12,
  QJP_GATE_SINE = 13,
  QJP_GATE_HALF_WIDTH = 14,
  QJP_GATE_HALF_HEIGHT = 15,
  QJP_GATE_ROUND = 16,
  QJP_GATE_YAW = 17,
  QJP_GATE_WORDS = 19,
  /* kinds of fields of the observation */
  QJP_SEE_POSITION = 1,
  QJP_SEE_VELOCITY = 2,
  QJP_SEE_ATTITUDE = 3,
  QJP_SEE_ROTATION = 4,
  QJP_SEE_COPY = 5,
  QJP_SEE_SCALED = 6,
  QJP_SEE_GATE = 7,
  /* of the observation's integers */
  QJP_Q30 = 30,
  QJP_YAW_EXPONENT = ${yaw_exponent},
  QJP_QUATERNION_EXPONENT = ${quaternion_exponent},
  QJP_ROWS_PER_BLOCK = 4,
  QJP_COLUMNS_PER_TURN = 8
};

/* A number of two words, the low one first. */
static inline int64_t qjp_long(const int32_t *words) {
  return words[1] * (INT64_C(1) << 32) + (uint32_t)words[0];
}

static inline uint32_t qjp_within(int32_t value, int32_t low, int32_t high) {
  return ((value >= low) && (value <= high)) ? 1U : 0U;
}

/* Checks of the contents, once the sizes and the hash are right. */
qjp_error qjp_check(const qjp_policy *policy);

/* The words of the first field of the state with a code, or 0. */
const int32_t *qjp_find(const qjp_policy *policy, qjp_field code);

#endif /* QJP_LAYOUT_H */
