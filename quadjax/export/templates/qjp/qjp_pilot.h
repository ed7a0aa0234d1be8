/* One drone flown by a .qjp policy of motor commands: what the glue code of autopilots shares. */
#ifndef QJP_PILOT_H
#define QJP_PILOT_H

#include "qjp.h"

#ifdef __cplusplus
extern "C" {
#endif

/* World north-east-down, body forward-right-down, SI units. Rotors by place: front-left,
 * front-right, rear-right, rear-left. */
typedef struct {
  float position[3];
  float velocity[3];
  float euler[3];      /* roll, pitch, yaw */
  float quaternion[4]; /* w, x, y, z */
  float rates[3];
  float rotor_speed[4]; /* rad/s */
} qjp_vehicle;

/* Steps since loading, and those in which something was wrong with the state. */
typedef struct {
  uint32_t steps;
  uint32_t nan_steps;
  uint32_t clipped_steps;
  uint32_t outside_steps;
} qjp_counters;

/* Zeroed, it is a pilot without a policy. */
typedef struct {
  uint32_t usable;
  uint32_t racing; /* since the first step after qjp_pilot_reset */
  qjp_policy policy;
  qjp_race race;
  float command[QJP_COMMANDS]; /* of the step before */
  qjp_counters counters;
} qjp_pilot;

/* Loads a policy; the words must stay. Returns 0, or what is wrong, for a log. has_rotor_speeds: the
 * autopilot measures them; a policy that observes them is refused otherwise. */
const char *qjp_pilot_load(qjp_pilot *pilot, const int32_t *words, uint32_t bytes,
                           uint32_t has_rotor_speeds);

/* The next step starts a race towards gate 0. */
void qjp_pilot_reset(qjp_pilot *pilot);

/* One step, to be called every policy.period_ns. motors: by place, each within 0 .. 1 and never NaN,
 * whatever comes in; all 0 without a usable policy. */
void qjp_pilot_step(qjp_pilot *pilot, const qjp_vehicle *vehicle, float motors[QJP_COMMANDS]);

#ifdef __cplusplus
}
#endif

#endif /* QJP_PILOT_H */
