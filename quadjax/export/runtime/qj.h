/*
 * A quadjax policy as data: checks its words and runs it, with integers only.
 *
 * The words are those of a .qjp file, or the table of an exported header. They stay where the caller
 * has them, in flash or in RAM; nothing is allocated and no C library is called. Buffers take 8 bytes
 * of stack for each neuron of the widest layer, 16 in qj_load. A policy that qj_load accepts cannot
 * overflow, and its commands are within the limits that its words state, whatever comes in. That is
 * no promise of a safe flight. The processor must be little-endian.
 *
 * World north-east-down, body forward-right-down, SI units. Rotors and their commands are in the
 * order front-left, front-right, rear-right, rear-left.
 *
 * With QJ_SAMPLED, which an export with --sampled defines in qj_sizes.h, policies that sample their
 * actions are accepted too. Without it nothing of that is compiled.
 */
#ifndef QJ_H
#define QJ_H

#include <stdint.h>

#include "qj_sizes.h" /* QJ_MAX_WIDTH, QJ_MAX_STATE: of the largest policy */

#ifdef __cplusplus
extern "C" {
#endif

/* The NEON kernel is compiled in for an ARM target whose flags allow NEON, and there it is the
 * default. With -DQJ_WITH_NEON=1 GCC compiles it in whatever the flags say (a stock Paparazzi build
 * says -mfpu=vfp): ask the operating system, by getauxval(AT_HWCAP), before setting the kernel. */
#if defined(__ARM_NEON) || defined(__ARM_NEON__)
#define QJ_HAS_NEON 1
#define QJ_DEFAULT_KERNEL QJ_NEON
#else
#if defined(QJ_WITH_NEON) && defined(__arm__) && defined(__GNUC__) && !defined(__clang__)
#define QJ_HAS_NEON 1
#else
#define QJ_HAS_NEON 0
#endif
#define QJ_DEFAULT_KERNEL QJ_SCALAR
#endif

#define QJ_COMMANDS 4
#define QJ_MAX_LAYERS 16                /* of the policy and of the estimator's residual networks */
#define QJ_INPUT_ONE (INT32_C(1) << 30) /* an input at the edge of its range */

typedef enum { QJ_SCALAR = 0, QJ_NEON = 1 } qj_kernel;

typedef enum {
  QJ_OK = 0,
  QJ_BAD_SIZE = 1,        /* shorter or longer than the words say, or no whole number of words */
  QJ_BAD_MAGIC = 2,       /* not a policy, or a big-endian processor */
  QJ_BAD_VERSION = 3,     /* of another version of the format */
  QJ_BAD_CHECKSUM = 4,    /* changed since it was written */
  QJ_TOO_LARGE = 5,       /* more neurons, layers or numbers than the macros above */
  QJ_BAD_HEADER = 6,      /* a number of the header that is not allowed */
  QJ_BAD_STATE = 7,       /* fields or ranges of the state */
  QJ_BAD_OBSERVATION = 8, /* how an input is computed */
  QJ_BAD_TRACK = 9,       /* a gate */
  QJ_BAD_PADDING = 10,    /* padding of a table that is not zero */
  QJ_BAD_RANGES = 11,     /* a layer of which a sum may overflow */
  QJ_BAD_ESTIMATOR = 12,  /* a number of an estimator */
  QJ_BAD_SELF_TEST = 13   /* other integers than the converter computed */
} qj_error;

/* What the commands are: propeller speeds in rpm, motor commands, or rates and specific thrust. */
typedef enum { QJ_RPM = 1, QJ_MOTOR = 2, QJ_RATES_THRUST = 3 } qj_kind;

/* Places of rotors. */
enum { QJ_FRONT_LEFT = 0, QJ_FRONT_RIGHT = 1, QJ_REAR_RIGHT = 2, QJ_REAR_LEFT = 3 };

/* Fields of the state. */
typedef enum {
  QJ_POSITION = 1,    /* m */
  QJ_VELOCITY = 2,    /* m/s, world */
  QJ_EULER = 3,       /* roll, pitch, yaw, rad */
  QJ_QUATERNION = 4,  /* w, x, y, z: body to world, of length one */
  QJ_RATES = 5,       /* p, q, r, rad/s */
  QJ_ROTOR_SPEED = 6, /* rad/s */
  QJ_MOMENT_EXT = 7,  /* external moment, N m, body */
  QJ_FORCE_EXT = 8,   /* external specific force, m/s^2, body */
  QJ_LAST_COMMAND = 9,
  QJ_ROTOR_RPM = 10,
  QJ_THRUST = 11,     /* specific, along body -z, m/s^2 */
  QJ_HIGHEST_RPM = 12 /* that the battery permits */
} qj_field;

typedef struct {
  uint32_t rows; /* of the policy; tables have rows and columns of zeros after them */
  uint32_t columns;
  uint32_t padded_rows;
  uint32_t padded_columns;
  const int32_t *weights; /* in blocks of four rows */
  const int32_t *bias;    /* two words each, the low one first */
} qj_layer;

/* A loaded policy. Read it, do not write anything but the kernel; its words must stay. */
typedef struct {
  const int32_t *words;
  qj_kernel kernel;
  uint32_t inputs;
  uint32_t layers;
  uint32_t state_size;
  uint32_t fields;
  uint32_t parts;
  uint32_t gates;
  uint32_t gate_words;
  uint32_t world_box;
  qj_kind kind;
  uint32_t output_shift;
  uint32_t fraction_bits; /* commands are integers of 2^-fraction_bits */
  uint32_t period_ns;     /* of a step */
  uint32_t position;      /* of the first number of the position in the state */
  const int32_t *low;     /* of each command */
  const int32_t *high;
  const int32_t *field;
  const int32_t *exponents; /* of the ranges of the state's numbers */
  const int32_t *part;
  const int32_t *input;
  const int32_t *gate;
  const int32_t *estimator; /* of the disturbances, or 0 */
  const int32_t *terms;
  const int32_t *battery; /* estimator of the highest rpm, or 0 */
  const int32_t *tests;
  qj_layer layer[QJ_MAX_LAYERS]; /* of the policy, then of the residual's thrust and moment */
#ifdef QJ_SAMPLED
  const int32_t *noise; /* of a policy that samples its actions, or 0 */
#endif
} qj_policy;

/* What was wrong with a state: bit i is number or input i, bit 31 any from there on. */
typedef struct {
  uint32_t clipped; /* numbers outside their range: taken as its edge */
  uint32_t nan;     /* numbers that are not a number: taken as zero */
  uint32_t outside; /* inputs of the network outside their range: taken as its edge */
} qj_status;

typedef enum {
  QJ_NO_EVENT = 0,
  QJ_GATE_PASSED = 1, /* through the opening: the next gate is the target now */
  QJ_GATE_MISSED = 2  /* through the gate's plane but not the opening; the target stays */
} qj_event;

/* One drone in its race. The caller owns it. */
typedef struct {
  int32_t previous[3]; /* position at the last update */
  uint32_t placed;     /* there is such a position */
  uint32_t target;     /* gate to pass next */
  uint32_t passed;
  uint32_t missed;
} qj_race;

/* Memory of the filters of external moment and force. All zero before the first update. */
typedef struct {
  int64_t s1[6];
  int64_t s2[6];
  uint32_t started;
} qj_estimator;

/* Memory of the estimator of the highest rpm. All zero before the first update. */
typedef struct {
  int64_t speed[QJ_COMMANDS];
  int64_t expected[QJ_COMMANDS];
  int64_t limited[QJ_COMMANDS];
  int64_t highest;
  uint32_t started;
} qj_battery;

/* Checks all words: sizes, version, checksum, every number, the proof that no input can overflow, and
 * the self-tests. The policy is usable only if the result is QJ_OK. It takes the time of about 100
 * inferences. */
qj_error qj_load(qj_policy *policy, const int32_t *words, uint32_t bytes);

/* The name of an error, for a log. */
const char *qj_error_name(qj_error error);

/* The number of self-tests that give other integers, with the kernel of the policy. */
uint32_t qj_self_test(const qj_policy *policy);

/* Whether the policy observes a field of the state. */
uint32_t qj_observes(const qj_policy *policy, qj_field field);

/* The network's inputs for a state (state_size floats), seen from the gate ``target``. */
qj_status qj_observe(const qj_policy *policy, uint32_t target, const float *state, int32_t *q);

/* Inputs of an own observation (inputs floats, in the units of the policy) as integers. */
qj_status qj_quantize(const qj_policy *policy, const float *x, int32_t *q);

/* Commands, integers, of inputs. trace: where to digest every sum, or 0. */
void qj_forward(const qj_policy *policy, const int32_t *q, int32_t command[QJ_COMMANDS],
                uint32_t *trace);

#ifdef QJ_SAMPLED
/* The same with the noise of the policy's training: Gaussian, added before the commands are clamped.
 * Without such a section in the words it is qj_forward. counter: memory of the generator, any number
 * before the first call; a call adds a constant to it. The same counter gives the same noise. */
void qj_sample(const qj_policy *policy, const int32_t *q, uint32_t *counter,
               int32_t command[QJ_COMMANDS]);
#endif

/* Integer commands as floats in their unit; rpm are rounded to whole ones. */
void qj_commands(const qj_policy *policy, const int32_t q[QJ_COMMANDS], float command[QJ_COMMANDS]);

/* Begin a race at a position, then update it with the position at every step; a position that is
 * not finite or outside its range is ignored. */
void qj_race_start(const qj_policy *policy, qj_race *race, const float position[3],
                   uint32_t target);
qj_event qj_race_update(const qj_policy *policy, qj_race *race, const float position[3]);

/* One sample of gyro (3), specific force (3), rotor rpm (4) and body velocity (3), at the rate of the
 * estimator. The first one takes the present rates and rpm as steady. */
qj_status qj_estimator_update(const qj_policy *policy, qj_estimator *estimator,
                              const float measured[13], float moment[3], float force[3]);

/* One sample of rotor rpm (4) and of the commands before it (4), at the rate of the estimator; the
 * highest rpm. The first one takes the present speeds as steady. */
qj_status qj_battery_update(const qj_policy *policy, qj_battery *battery, const float sample[8],
                            float *highest_rpm);

#ifdef __cplusplus
}
#endif

#endif /* QJ_H */
