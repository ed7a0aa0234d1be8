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

/* What is wrong with the policy, or 0. The module neither flies nor lets anybody arm unless it is
 * 0. */
const char *quadjax_module_wrong(void);

/* For a policy that commands the motors. Whether it flies now; then its commands, rpm in the order
 * of the board's motors. Call it at the top of actuators_bebop_commit(). */
bool quadjax_module_rpm(uint16_t rpm[4]);

/* For a policy that commands rates and thrust. Whether it flies now; then the inner loop (INDI) has
 * run with its commands. Call it in place of the loop that follows the stick. */
bool quadjax_module_inner_loop(bool in_flight);

#endif /* QUADJAX_MODULE_H */
