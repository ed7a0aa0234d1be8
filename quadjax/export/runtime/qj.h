/*
 * A quadjax racing policy in C: the network in fixed point, everything around it in float.
 *
 * A policy is a constant struct, defined by the header that quadjax export writes. Nothing is
 * allocated and no file is read; the C library is used for sinf, cosf, asinf, atan2f, sqrtf, logf,
 * floorf and fabsf only. The network computes the same bits on every processor and by every
 * compiler: it is integers, proven not to overflow for any input. The rest is ordinary float, which
 * differs in its last digits between processors unless it is compiled with -ffp-contract=off and
 * without -ffast-math.
 *
 * World north-east-down, body forward-right-down, SI units. Rotors and their commands are in the
 * order front-left, front-right, rear-right, rear-left.
 */
#ifndef QJ_H
#define QJ_H

#include <stdint.h>

#include "qj_sizes.h" /* QJ_MAX_WIDTH: neurons or inputs of the widest layer, a multiple of 8 */

#ifdef __cplusplus
extern "C" {
#endif

#define QJ_COMMANDS 4
#define QJ_ONE (INT32_C(1) << 30) /* an input of the network at the edge of its range */
#define QJ_RPM_PER_RAD_S 9.549296585513721F
#define QJ_LARGEST 1e6F /* magnitude of a number of a state: one beyond it is taken as wrong */

/* ---- the kernels of the network -------------------------------------------------------------- */

/* The NEON kernel is compiled in for an ARM target whose flags allow NEON, and there it is the
 * default. With -DQJ_WITH_NEON=1 GCC compiles it in whatever the flags say (a stock Paparazzi build
 * says -mfpu=vfp): ask the operating system, by getauxval(AT_HWCAP), before choosing it. */
typedef enum { QJ_SCALAR = 0, QJ_NEON = 1 } qj_kernel;

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

/* ---- what a policy consists of --------------------------------------------------------------- */

/* What the commands are: rotor speeds in rpm, motor commands of 0 to 1, or p, q, r in rad/s and
 * specific thrust in m/s^2. */
typedef enum { QJ_RPM = 1, QJ_MOTOR = 2, QJ_RATES_THRUST = 3 } qj_kind;

/* Fields of the observation; "gate" is the frame of the target gate: through it, to its right,
 * down. */
typedef enum {
  QJ_POSITION = 1,     /* 3, of the drone from the gate's center, gate, m */
  QJ_VELOCITY = 2,     /* 3, gate, m/s */
  QJ_ATTITUDE = 3,     /* 3, roll, pitch, yaw relative to the gate within half a turn, rad */
  QJ_ROTATION = 4,     /* 6, the body's x and z axes, gate */
  QJ_RATES = 5,        /* 3, p, q, r, rad/s */
  QJ_ROTOR_SPEED = 6,  /* 4, rad/s */
  QJ_THRUST = 7,       /* 1, specific thrust along body -z, m/s^2 */
  QJ_LAST_COMMAND = 8, /* 4, of the step before */
  QJ_MOMENT_EXT = 9,   /* 3, estimated external moment, N m, body */
  QJ_FORCE_EXT_Z = 10, /* 1, estimated external specific force along body z, m/s^2 */
  QJ_HIGHEST_RPM = 11, /* 1, estimate of the highest speed that the battery permits, rpm */
  QJ_OF_GATE = 12      /* any, constants of the target gate: the gates after it */
} qj_field;

typedef struct {
  uint32_t field; /* of qj_field */
  uint32_t size;  /* number of inputs */
} qj_part;

/* An input of the network is (value - middle) factor, within +-range, a power of two. */
typedef struct {
  float middle;
  float factor;
  float range;
} qj_input;

/* Rows of hidden neurons y = max(0, (bias + sum of weight x) >> 32), or the sums of the output. */
typedef struct {
  uint32_t rows;
  uint32_t columns;
  uint32_t padded_rows; /* the tables have zeros after the rows and columns */
  uint32_t padded_columns;
  const int32_t *weights; /* in blocks of four rows: the four weights of column 0, of column 1 .. */
  const int64_t *bias;    /* the half that rounds is folded in */
} qj_layer;

/* What counts as passing: inside the opening at the first sample past its plane, inside it where
 * the line between two samples meets the plane, or in a box along the world's axes at that
 * sample. */
typedef enum { QJ_SQUARE = 0, QJ_INTERPOLATED = 1, QJ_WORLD_BOX = 2 } qj_gate_test;

typedef struct {
  float position[3]; /* center, m */
  float axes[3][3];  /* rows: unit vectors through the opening, along its width, along its height */
  float yaw;         /* rad */
  float cos_yaw;
  float sin_yaw;
  float half_width; /* m, less the radius of the drone's body; of a circle its radius, less that */
  float half_height;
  uint32_t is_round;
} qj_gate;

/* A float layer of a residual network, row by row. */
typedef struct {
  uint32_t rows;
  uint32_t columns;
  const float *weights;
  const float *bias;
} qj_float_layer;

/* What the networks of a residual add to the model, of rotor speeds scaled from low_rpm .. high_rpm
 * to -1 .. 1, body velocity and, for the moment, body rates. */
typedef struct {
  float low_rpm;
  float high_rpm;
  uint32_t thrust_layers;
  uint32_t moment_layers;
  const qj_float_layer *thrust; /* one output, added to the specific force along body z, m/s^2 */
  const qj_float_layer *moment; /* three outputs, N m */
} qj_residual;

/* The estimator of external moment and force: measured minus modeled, through a low-pass. */
typedef struct {
  float sample_rate; /* Hz */
  float k_w, k_x, k_y, k_z, k_h;
  float k_p, k_q, k_pv, k_qv, k_r1, k_r2, k_rr;
  float inertia[3];
  float feedback[2]; /* of the second-order Butterworth low-pass */
  float low_pass[3];
  float derivative[3];
  const qj_residual *residual; /* or 0 */
} qj_disturbance_model;

/* The estimator of the highest rotor speed that the battery permits. */
typedef struct {
  float sample_rate; /* Hz */
  float lowest;      /* rpm */
  float highest;
  float first; /* estimate */
  float low_pass;
  float lead;
  float gain;
} qj_battery_model;

typedef struct {
  const char *name;
  qj_kind kind;
  float step_s; /* time step of the training */
  uint32_t inputs;
  uint32_t layers;
  uint32_t parts;
  uint32_t gates;
  uint32_t gate_constants; /* of each gate */
  uint32_t output_shift;   /* from the output's sums to commands of 2^-fraction_bits */
  uint32_t fraction_bits;
  int32_t low[QJ_COMMANDS]; /* of the commands */
  int32_t high[QJ_COMMANDS];
  const qj_layer *layer;
  const qj_part *part;
  const qj_input *input;
  const qj_gate *gate;
  const float *gate_constant;
  qj_gate_test gate_test;
  const qj_disturbance_model *disturbance; /* or 0 */
  const qj_battery_model *battery;         /* or 0 */
  /* Standard deviation of each command, in its unit, of a policy that samples its actions; or 0. */
  const float *noise;
  uint32_t noise_on_clamped; /* the noise is added to the mean within the limits */
  uint32_t hash;             /* of the tables */
  uint32_t tests;
  const int32_t *test_input; /* inputs of the network */
  const int32_t *test_command;
  const uint32_t *test_trace; /* digest of every sum */
} qj_policy;

/* ---- the network ----------------------------------------------------------------------------- */

/* By the bits, and volatile, so that it holds with -ffast-math too. */
static inline uint32_t qj_is_finite(float value) {
  volatile union {
    float value;
    uint32_t bits;
  } pun;
  pun.value = value;
  return ((pun.bits & UINT32_C(0x7F800000)) != UINT32_C(0x7F800000)) ? 1U : 0U;
}

/* What was wrong with the inputs of a step: bit i is input i, bit 31 any from there on. */
typedef struct {
  uint32_t nan;     /* not finite: taken as zero */
  uint32_t outside; /* outside its range: taken as its edge */
} qj_status;

/* Inputs of the network (inputs floats) as integers. */
qj_status qj_quantize(const qj_policy *policy, const float *x, int32_t *q);

/* Commands of inputs, within their limits, in units of 2^-fraction_bits. trace: digest of every
 * sum, or 0. */
void qj_forward(const qj_policy *policy, qj_kernel kernel, const int32_t *q,
                int32_t command[QJ_COMMANDS], uint32_t *trace);

/* The same as floats in their unit; rpm are whole ones. counter: where the counter of the noise is,
 * or a null pointer for the mean action. With one, a policy that samples its actions draws Gaussian
 * noise: the same number gives the same noise, and a call moves it on. */
void qj_act(const qj_policy *policy, qj_kernel kernel, const int32_t *q, uint32_t *counter,
            float command[QJ_COMMANDS]);

/* Whether the tables have their hash, and every self-test its integers. */
uint32_t qj_self_test(const qj_policy *policy, qj_kernel kernel);

/* ---- the observation ------------------------------------------------------------------------- */

/* A drone as a policy observes it. */
typedef struct {
  float position[3];
  float velocity[3];   /* world */
  float quaternion[4]; /* w, x, y, z: body to world, of length one */
  float rates[3];      /* p, q, r */
  float rotor_speed[4]; /* rad/s */
  float thrust;         /* specific, along body -z, m/s^2 */
  float last_command[QJ_COMMANDS];
  float moment_ext[3]; /* N m, body */
  float force_ext[3];  /* specific, m/s^2, body */
  float highest_rpm;
} qj_state;

/* The inputs of the network (inputs floats), seen from the gate ``target``. */
void qj_observe(const qj_policy *policy, const qj_state *state, uint32_t target, float *x);

/* Whether the policy observes a field. */
uint32_t qj_observes(const qj_policy *policy, qj_field field);

/* One attitude from the other; yaw, then pitch, then roll. */
void qj_euler_of(const float quaternion[4], float euler[3]);
void qj_quaternion_of(const float euler[3], float quaternion[4]);

/* ---- the race -------------------------------------------------------------------------------- */

typedef enum {
  QJ_NO_EVENT = 0,
  QJ_GATE_PASSED = 1, /* through the opening: the next gate is the target now */
  QJ_GATE_MISSED = 2  /* through the gate's plane but not the opening; the target stays */
} qj_event;

typedef struct {
  float previous[3]; /* position at the last update */
  uint32_t placed;   /* there is such a position */
  uint32_t target;   /* gate to pass next */
  uint32_t passed;
  uint32_t missed;
} qj_race;

/* Begin a race, then update it with the position at every step; a position that is not finite is
 * ignored. */
void qj_race_start(qj_race *race);
qj_event qj_race_update(const qj_policy *policy, qj_race *race, const float position[3]);

/* ---- the estimators -------------------------------------------------------------------------- */

/* One sample of the sensors of an estimator. */
typedef struct {
  float rates[3];          /* gyro, rad/s */
  float specific_force[3]; /* accelerometer, m/s^2 */
  float rotor_rpm[4];
  float body_velocity[3]; /* m/s */
} qj_measured;

/* Memory of the filters of moment (0 to 2) and force (3 to 5). */
typedef struct {
  float first[6];
  float second[6];
} qj_disturbance;

/* Memory of the estimator of the highest rpm. */
typedef struct {
  float speed[4];
  float expected[4];
  float limited[4];
} qj_battery;

/* Start at a sample that is taken as steady, with an estimate of moment and force (6), which the
 * next samples continue; zeros at the beginning. */
void qj_disturbance_start(const qj_disturbance_model *model, qj_disturbance *memory,
                          const qj_measured *measured, const float estimate[6]);

/* One sample at the model's rate; the new estimate of moment and force. */
void qj_disturbance_update(const qj_disturbance_model *model, qj_disturbance *memory,
                           const qj_measured *measured, float estimate[6]);

/* Start at rotor speeds that are taken as steady, rpm. */
void qj_battery_start(qj_battery *memory, const float rotor_rpm[4]);

/* One sample of rotor speeds and of the commands before it, rpm; changes the estimate, rpm. */
void qj_battery_update(const qj_battery_model *model, qj_battery *memory, const float rotor_rpm[4],
                       const float command[4], float *highest_rpm);

#ifdef __cplusplus
}
#endif

#endif /* QJ_H */
