/* Connects the pilot of an export to another autopilot: estimates in, rate commands out. */
#include "qj_pilot.h"
#include "racer.h" /* written by quadjax export */

#define LOOP_US 2000U /* period of the autopilot's loop: 500 Hz */

typedef struct { /* filled by the autopilot: north-east-down, forward-right-down, SI */
  uint32_t time_us;
  float position[3], velocity[3], rates[3], quaternion[4], thrust;
} estimate_t;

static qj_pilot pilot;

/* At start-up. Returns 0, or why the policy cannot fly: then refuse to arm. */
const char *policy_setup(void) {
  const qj_interface interface = {
      QJ_GIVES(QJ_EULER) | QJ_GIVES(QJ_QUATERNION) | QJ_GIVES(QJ_THRUST), /* what the autopilot measures */
      QJ_GIVES(QJ_RATES_THRUST),                                          /* the commands that it takes */
      1000U * LOOP_US};
  return qj_pilot_load(&pilot, racer_words, sizeof(racer_words), &interface);
}

/* Call in every loop. active: whether the policy's mode is on; if not, the next race is prepared.
 * command: p, q, r and specific thrust, all 0 if the estimate is lost (QJ_LOST). */
qj_pilot_status policy_loop(uint32_t now_us, const estimate_t *estimate, uint32_t active,
                            float command[QJ_COMMANDS]) {
  qj_vehicle vehicle = {.time_us = estimate->time_us, .thrust = {estimate->thrust}};
  for (int i = 0; i < 4; ++i) {
    vehicle.quaternion[i] = estimate->quaternion[i];
  }
  for (int i = 0; i < 3; ++i) {
    vehicle.position[i] = estimate->position[i];
    vehicle.velocity[i] = estimate->velocity[i];
    vehicle.rates[i] = estimate->rates[i];
  }
  qj_euler_of(vehicle.quaternion, vehicle.euler);
  if (active == 0U) {
    qj_pilot_wait(&pilot, &vehicle);
    return QJ_HELD;
  }
  return qj_pilot_step(&pilot, now_us, &vehicle, command);
}

uint32_t policy_target_gate(void) { return pilot.race.target; }
