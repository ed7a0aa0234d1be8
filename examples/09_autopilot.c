/* Connects the pilot of an export to another autopilot: estimates in, rate commands out. */
#include "qj_pilot.h"
#include "racer.h" /* written by quadjax export */

#define LOOP_HZ 500 /* of the autopilot's loop */

typedef struct { /* filled by the autopilot: north-east-down, forward-right-down, SI */
  uint32_t time_us, position_us;
  float position[3], velocity[3], rates[3], quaternion[4], thrust;
} estimate_t;

static qj_pilot pilot;

/* At start-up. Returns 0, or why the policy cannot fly: then refuse to arm. */
const char *policy_setup(void) {
  return qj_pilot_start(&pilot, &racer_policy, QJ_DEFAULT_KERNEL, (float)LOOP_HZ);
}

/* Call in every loop. active: whether the policy's mode is on; if not, the next race is prepared.
 * command: p, q, r and specific thrust, all 0 with QJ_LOST: no estimate, or not active. */
qj_pilot_status policy_loop(uint32_t now_us, const estimate_t *estimate, uint32_t active,
                            float command[QJ_COMMANDS]) {
  qj_vehicle vehicle = {.time_us = estimate->time_us,
                        .position_us = estimate->position_us,
                        .thrust = estimate->thrust};
  for (int i = 0; i < 4; ++i) {
    vehicle.quaternion[i] = estimate->quaternion[i];
  }
  for (int i = 0; i < 3; ++i) {
    vehicle.position[i] = estimate->position[i];
    vehicle.velocity[i] = estimate->velocity[i];
    vehicle.rates[i] = estimate->rates[i];
  }
  if (active == 0U) {
    qj_pilot_standby(&pilot, &vehicle);
    for (int i = 0; i < QJ_COMMANDS; ++i) {
      command[i] = 0.0F;
    }
    return QJ_LOST;
  }
  return qj_pilot_call(&pilot, now_us, &vehicle, command);
}

uint32_t policy_target_gate(void) { return pilot.race.target; }
