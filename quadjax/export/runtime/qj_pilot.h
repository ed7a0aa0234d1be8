/* One drone flown by a policy: state, estimators, step clock, commands and counters. What an autopilot
 * needs beside this is a glue file that fills qj_vehicle and passes the commands on. */
#ifndef QJ_PILOT_H
#define QJ_PILOT_H

#include "qj.h"

#ifdef __cplusplus
extern "C" {
#endif

#define QJ_STALE_US 100000U /* a state older than that, or as far ahead, is not used */
#define QJ_HOLD_US 100000U  /* without a state, the last commands are held that long, then all are 0 */

/* Bits of qj_interface.gives: sensors of the estimators, and the fields 1 << QJ_ROTOR_SPEED and so
 * on. Position, velocity and rates are always given. */
#define QJ_GIVES(field) (UINT32_C(1) << (uint32_t)(field))
#define QJ_GIVES_SENSORS (UINT32_C(1) << 16) /* gyro, specific force and body velocity */

/* What an autopilot measures and takes. */
typedef struct {
  uint32_t gives;
  uint32_t kinds;   /* commands that it takes: QJ_GIVES(QJ_MOTOR) and so on */
  uint32_t call_ns; /* between two calls of qj_pilot_step */
} qj_interface;

/* World north-east-down, body forward-right-down, SI units; rotors front-left, front-right,
 * rear-right, rear-left. What an autopilot does not measure is not read. */
typedef struct {
  uint32_t time_us; /* of the state; it may wrap around */
  float position[3];
  float velocity[3];
  float euler[3];      /* roll, pitch, yaw */
  float quaternion[4]; /* w, x, y, z */
  float rates[3];
  float rotor_speed[4]; /* rad/s */
  float rotor_rpm[4];   /* the same, rpm */
  float thrust[1];      /* specific, along body -z, m/s^2 */
  float moment_ext[3];  /* of an estimator of the autopilot's own */
  float force_ext[3];
  float gyro[3];           /* sensors of the policy's estimators */
  float specific_force[3]; /* of the accelerometer, m/s^2, body */
  float body_velocity[3];
  float others_command[4]; /* rpm that the autopilot commands while the policy does not fly */
} qj_vehicle;

/* Steps since loading, and those in which something was wrong. */
typedef struct {
  uint32_t steps;
  uint32_t nan_steps;       /* a number of the state was NaN: taken as zero */
  uint32_t clipped_steps;   /* a number was outside its range: taken as its edge */
  uint32_t outside_steps;   /* an input of the network was outside its range */
  uint32_t estimator_calls; /* a measurement of an estimator was NaN or clipped */
  uint32_t late_calls;      /* the state was stale, or not newer than the one before */
} qj_counters;

typedef enum {
  QJ_UNUSABLE = 0, /* no policy: the commands are 0 */
  QJ_FLYING = 1,   /* a step, or the commands of the present step */
  QJ_HELD = 2,     /* no new state: the last commands */
  QJ_LOST = 3      /* no state for QJ_HOLD_US: the commands are 0 */
} qj_pilot_status;

/* Zeroed, it is a pilot without a policy. */
typedef struct {
  uint32_t usable;
  uint32_t racing; /* since the first step after qj_pilot_reset */
  uint32_t every_call; /* the policy observes no earlier step: it runs at every call */
  uint32_t own_estimator; /* the policy's estimator of disturbances runs */
  uint32_t gives;
  uint32_t due_us;   /* from a step to the next: its period less half a call */
  uint32_t step_us;  /* time of the call of the last step */
  uint32_t state_us; /* time of the newest state */
  uint32_t lost;     /* states were missing in the last call */
  uint32_t lost_us;  /* since when */
  float command[QJ_COMMANDS]; /* of the step before; at first halfway between the limits */
  float moment[3];
  float force[3];
  float highest_rpm[1];
  qj_status last;
  qj_counters counters;
  qj_policy policy;
  qj_race race;
  qj_estimator estimator;
  qj_battery battery;
#ifdef QJ_SAMPLED
  uint32_t noise; /* counter of the generator, which nothing resets: set it to any number */
#endif
} qj_pilot;

/* Loads a policy; the words must stay. Returns 0, or what is wrong, for a log. */
const char *qj_pilot_load(qj_pilot *pilot, const int32_t *words, uint32_t bytes,
                          const qj_interface *interface);

/* The next step starts a race towards gate 0. */
void qj_pilot_reset(qj_pilot *pilot);

/* A call in which the policy does not fly: its estimators run, and a race ends. */
void qj_pilot_wait(qj_pilot *pilot, const qj_vehicle *vehicle);

/* A call in which it flies, every call_ns: the estimators run, and at every step of the policy its
 * commands change. vehicle: 0 if there is no valid state. now_us: of the call, on the clock of
 * vehicle->time_us; the steps follow it.
 * The commands are within the policy's limits and never NaN, whatever comes in, or all 0. */
qj_pilot_status qj_pilot_step(qj_pilot *pilot, uint32_t now_us, const qj_vehicle *vehicle,
                              float command[QJ_COMMANDS]);

/* One attitude from the other; they need sinf, cosf, asinf and atan2f: qj_angles.c. */
void qj_euler_of(const float quaternion[4], float euler[3]);
void qj_quaternion_of(const float euler[3], float quaternion[4]);

#ifdef __cplusplus
}
#endif

#endif /* QJ_PILOT_H */
