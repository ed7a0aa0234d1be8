/*
 * A quadjax policy as a file (.qjp): checks it and runs it, with integers only.
 *
 * The words of the file stay where the caller has them, in RAM or in flash; nothing is allocated and
 * no C library is called. A policy that qjp_load accepts cannot overflow, and its commands are
 * within the limits that its file states, whatever comes in. The same bits as the exported C.
 * The processor must be little-endian.
 */
#ifndef QJP_H
#define QJP_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define QJP_VERSION 1

/* Largest policies; larger ones are rejected. Stack: 8 bytes for each neuron of the widest layer, 16
 * in qjp_load; with -DQJP_STATIC=1 they are static instead, and only one task may call the
 * functions. Define others for the whole build. */
#ifdef QJP_STATIC
#define QJP_BUFFER static
#else
#define QJP_BUFFER
#endif
#ifndef QJP_MAX_WIDTH
#define QJP_MAX_WIDTH 128 /* neurons or inputs of a layer, padded to a multiple of 8 */
#endif
#ifndef QJP_MAX_LAYERS
#define QJP_MAX_LAYERS 8
#endif
#ifndef QJP_MAX_STATE
#define QJP_MAX_STATE 64 /* numbers of the state */
#endif

#define QJP_COMMANDS 4
#define QJP_INPUT_ONE (INT32_C(1) << 30) /* an input at the edge of its range */

typedef enum {
  QJP_OK = 0,
  QJP_BAD_SIZE = 1,         /* shorter or longer than the file says, or no whole number of words */
  QJP_BAD_MAGIC = 2,        /* not a .qjp, or a big-endian processor */
  QJP_BAD_VERSION = 3,      /* of another version of the format */
  QJP_BAD_HASH = 4,         /* changed since it was written */
  QJP_TOO_LARGE = 5,        /* more inputs, layers, neurons or numbers than the macros above */
  QJP_BAD_HEADER = 6,       /* a number of the header that is not allowed */
  QJP_BAD_STATE = 7,        /* fields or ranges of the state */
  QJP_BAD_OBSERVATION = 8,  /* how an input is computed */
  QJP_BAD_TRACK = 9,        /* a gate */
  QJP_BAD_PADDING = 10,     /* padding of a table that is not zero */
  QJP_BAD_CERTIFICATE = 11, /* a layer that may overflow, or ranges that are not those stated */
  QJP_BAD_SELF_TEST = 12    /* other integers than the converter computed */
} qjp_error;

/* What the commands are. */
typedef enum { QJP_RPM = 1, QJP_MOTOR = 2, QJP_OTHER = 3 } qjp_command_kind;

/* Places of rotors. */
enum { QJP_FRONT_LEFT = 0, QJP_FRONT_RIGHT = 1, QJP_REAR_RIGHT = 2, QJP_REAR_LEFT = 3 };

/* Fields of the state. World north-east-down, body forward-right-down, SI units. */
typedef enum {
  QJP_POSITION = 1,    /* m */
  QJP_VELOCITY = 2,    /* m/s, world */
  QJP_EULER = 3,       /* roll, pitch, yaw, rad */
  QJP_QUATERNION = 4,  /* w, x, y, z: body to world, of length one */
  QJP_RATES = 5,       /* p, q, r, rad/s */
  QJP_ROTOR_SPEED = 6, /* rad/s, in the order of the commands */
  QJP_MOMENT_EXT = 7,  /* N m, body */
  QJP_FORCE_EXT = 8,   /* m/s^2, body */
  QJP_LAST_COMMAND = 9,
  QJP_ROTOR_RPM = 10,
  QJP_THRUST = 11 /* specific, m/s^2 */
} qjp_field;

typedef struct {
  uint32_t rows; /* of the policy */
  uint32_t columns;
  uint32_t padded_rows;
  uint32_t padded_columns;
  const int32_t *weights; /* in blocks of four rows */
  const int32_t *bias;    /* two words each, the low one first */
} qjp_layer;

/* A loaded policy. Read it, do not write it; its words must stay where they are. */
typedef struct {
  uint32_t inputs;
  uint32_t layers;
  uint32_t state_size;
  uint32_t fields;
  uint32_t parts;
  uint32_t gates;
  uint32_t constants; /* inputs that depend on the gate alone */
  uint32_t world_box;
  uint32_t kind; /* a qjp_command_kind */
  uint32_t output_shift;
  uint32_t fraction_bits; /* commands are integers of 2^-fraction_bits */
  uint32_t period_ns;     /* of a step */
  uint32_t network_tests;
  uint32_t race_tests;
  const char *name;     /* ends with a zero */
  const char *vehicle;  /* model; ends with a zero */
  const uint8_t *source; /* SHA-256 of the policy file, 32 bytes */
  const int32_t *places; /* of the rotor of each command */
  const int32_t *low;    /* of each command */
  const int32_t *high;
  const int32_t *certificate;
  const int32_t *field;
  const int32_t *exponents; /* of the ranges of the state's numbers */
  const int32_t *part;
  const int32_t *input;
  const int32_t *gate;
  const int32_t *tests;
  qjp_layer layer[QJP_MAX_LAYERS];
} qjp_policy;

/* What was wrong with a state: bit i is number or input i, bit 31 any from there on. */
typedef struct {
  uint32_t clipped; /* numbers outside their range: taken as its edge */
  uint32_t nan;     /* numbers that are not a number: taken as zero */
  uint32_t outside; /* inputs of the network outside their range: taken as its edge */
} qjp_status;

typedef enum { QJP_NO_EVENT = 0, QJP_GATE_PASSED = 1, QJP_GATE_MISSED = 2 } qjp_event;

/* One drone in its race. The caller owns it. */
typedef struct {
  int32_t previous[3];
  uint32_t target; /* gate to pass next */
  uint32_t passed;
  uint32_t missed;
} qjp_race;

/* Checks a whole file: sizes, version, hash, every number, the proof that no input can overflow, and
 * the self-tests. policy is usable only if the result is QJP_OK. It takes the time of about 40
 * inferences and of hashing the file. */
qjp_error qjp_load(qjp_policy *policy, const int32_t *words, uint32_t bytes);

/* The name of an error, for a log. */
const char *qjp_error_name(qjp_error error);

/* Whether the policy observes a field of the state. */
uint32_t qjp_observes(const qjp_policy *policy, qjp_field field);

/* Whether every command is a motor command within 0 .. 1. */
uint32_t qjp_is_motor_policy(const qjp_policy *policy);

/* Copies the values of a field into the state, if the state has it. */
void qjp_set(const qjp_policy *policy, float *state, qjp_field field, const float *values);

/* The bits of one float of range +-2^exponent to an integer of which the range is +-2^30. exponent
 * is -96 to 96. The two flags are 1 or 0. */
int32_t qjp_quantize_one(uint32_t bits, int32_t exponent, uint32_t *clipped, uint32_t *nan);

/* The network's inputs for a state, seen from gate target. */
qjp_status qjp_observe(const qjp_policy *policy, const float *state, uint32_t target, int32_t *q);

/* Commands, integers, of inputs. trace: where to digest every accumulator, or 0. */
void qjp_forward(const qjp_policy *policy, const int32_t *q, int32_t command[QJP_COMMANDS],
                 uint32_t *trace);

/* Integer commands as floats in their unit. */
void qjp_commands(const qjp_policy *policy, const int32_t q[QJP_COMMANDS],
                  float command[QJP_COMMANDS]);

/* Begin a race at a position, then update it with the position at every step; a position that is
 * not finite or outside its range is ignored. */
void qjp_race_start(const qjp_policy *policy, qjp_race *race, const float position[3],
                    uint32_t target);
qjp_event qjp_race_update(const qjp_policy *policy, qjp_race *race, const float position[3]);

/* The number of self-tests of the file that give other integers; qjp_load calls it. */
uint32_t qjp_self_test(const qjp_policy *policy);

/* SHA-256 of bytes. */
void qjp_sha256(const uint8_t *data, uint32_t size, uint8_t digest[32]);

#ifdef __cplusplus
}
#endif

#endif /* QJP_H */
