/* One drone flown by a policy: observation, estimators, step clock, commands and counters. What an
 * autopilot needs beside this is a glue file that fills qj_vehicle and passes the commands on. */
#ifndef QJ_PILOT_H
#define QJ_PILOT_H

#include "qj.h"

#ifdef __cplusplus
extern "C" {
#endif

#define QJ_STALE_US 100000U   /* a state older than that, or as far ahead, is not used */
#define QJ_HOLD_US 100000U    /* without a state, the last commands are held so long, then 0 */
#define QJ_GIVE_UP_US 500000U /* after that long, all are 0 until qj_pilot_reset */

/* What an autopilot knows. What it does not measure is zeros; quadjax export has checked that
 * neither the policy nor its estimators need it. A state with a number that is not finite, or
 * above QJ_LARGEST, is not used. */
typedef struct {
  uint32_t time_us;     /* of the rates, the rotor speeds and the sensors; it may wrap around */
  uint32_t position_us; /* of the position, on the same clock */
  float position[3];
  float velocity[3];   /* world */
  float quaternion[4]; /* w, x, y, z: body to world, of length one */
  float rates[3];
  float rotor_speed[4]; /* rad/s */
  float thrust;         /* specific, along body -z, m/s^2 */
  float specific_force[3];             /* accelerometer less its bias, m/s^2: for the estimators */
  float body_velocity[3];              /* m/s: for the estimators */
  float autopilot_command[QJ_COMMANDS]; /* rpm, while the policy does not fly: for the estimators */
} qj_vehicle;

/* Steps since qj_pilot_start, and what was wrong. */
typedef struct {
  uint32_t steps;
  uint32_t outside_steps; /* an input of the network was outside its range: taken as its edge */
  uint32_t late_calls;    /* no state, or it was stale, or not newer than the one before */
  uint32_t nan_calls;     /* a number of the state was not finite or above QJ_LARGEST */
} qj_counters;

/* Whether a race has its states. */
typedef enum {
  QJ_HAS_STATE = 0,
  QJ_MISSES_STATE = 1, /* since lost_us */
  QJ_GAVE_UP = 2       /* after QJ_GIVE_UP_US: until qj_pilot_reset */
} qj_pilot_link;

typedef enum {
  QJ_UNUSABLE = 0, /* no policy: the commands are 0 */
  QJ_FLYING = 1,   /* a step, or the commands of the present step */
  QJ_HELD = 2,     /* no new state: the last commands */
  QJ_LOST = 3      /* no state for QJ_HOLD_US: the commands are 0 */
} qj_pilot_status;

/* Zeroed, it is a pilot without a policy. */
typedef struct {
  const qj_policy *policy; /* 0: none that may fly */
  qj_kernel kernel;
  uint32_t every_call; /* the policy observes no earlier step: it runs at every call */
  uint32_t call_us;
  uint32_t racing;   /* since the first step after qj_pilot_reset */
  uint32_t step_us;  /* time of the call of the last step */
  uint32_t state_us; /* time of the newest state */
  uint32_t has_state;
  qj_pilot_link link;
  uint32_t lost_us;
  uint32_t noise;   /* counter of a policy that samples its actions: set it to any number */
  uint32_t outside; /* inputs outside their ranges since qj_pilot_reset: bit i: input i, 31: more */
  qj_state state;   /* as observed; last_command are the present commands */
  qj_measured measured; /* of the newest state, for the estimators */
  float estimate[6];    /* moment, force */
  qj_counters counters;
  qj_race race;
  qj_disturbance disturbance;
  qj_battery battery;
} qj_pilot;

/* Takes a policy, whose calls come at a rate, Hz. Returns 0, or what is wrong, for a log: then
 * refuse to arm. It takes the time of about 20 inferences. */
const char *qj_pilot_start(qj_pilot *pilot, const qj_policy *policy, qj_kernel kernel,
                           float calls_per_s);

/* The next step starts a race towards gate 0. */
void qj_pilot_reset(qj_pilot *pilot);

/* A call in which the policy does not fly: its estimators run, and a race ends. vehicle: 0 if there
 * is no valid state. */
void qj_pilot_standby(qj_pilot *pilot, const qj_vehicle *vehicle);

/* A call in which it flies: the estimators run, and at every step of the policy its commands
 * change. now_us: of the call, on the clock of the vehicle; the steps follow it. The commands are
 * within the policy's limits and never NaN, whatever comes in, or all 0. */
qj_pilot_status qj_pilot_call(qj_pilot *pilot, uint32_t now_us, const qj_vehicle *vehicle,
                              float command[QJ_COMMANDS]);

#ifdef __cplusplus
}
#endif

#endif /* QJ_PILOT_H */
