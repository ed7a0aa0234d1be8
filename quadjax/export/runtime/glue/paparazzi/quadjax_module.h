/* A quadjax policy as a Paparazzi module for the Parrot Bebop. */
#ifndef QUADJAX_MODULE_H
#define QUADJAX_MODULE_H

#include <stdbool.h>
#include <stdint.h>

/* Autopilot mode in which the policy flies. */
#ifndef QUADJAX_MODE
#define QUADJAX_MODE AP_MODE_MODULE
#endif

extern uint8_t quadjax_module_enable; /* setting: 0 leaves the drone to the autopilot */

void quadjax_module_init(void);
void quadjax_module_periodic(void); /* at QUADJAX_FREQUENCY of quadjax_policy.h */

/* What is wrong with the policy, or 0. The module neither flies nor lets anybody arm unless it is 0. */
const char *quadjax_module_wrong(void);

/* Whether the policy flies now; and its commands: rpm in the order of the board's motors, or p, q, r in
 * rad/s and specific thrust in m/s^2. Call it at the top of actuators_bebop_commit() and copy rpm to
 * actuators_bebop.rpm_ref, or give rates and thrust to the inner loop in place of the stick's. */
bool quadjax_module_command(float command[4]);

#endif /* QUADJAX_MODULE_H */
