/*
 * ${name}_module: the racing policy as a Paparazzi module for the Parrot Bebop.
 *
${origin.lines | comment}
 */
#ifndef ${NAME}_MODULE_H
#define ${NAME}_MODULE_H

#include <stdbool.h>
#include <stdint.h>

/* Autopilot mode in which the network flies. */
#ifndef ${NAME}_MODE
#define ${NAME}_MODE AP_MODE_MODULE
#endif

extern uint8_t ${name}_module_enable; /* setting: 0 leaves the drone to the autopilot */

void ${name}_module_init(void);
void ${name}_module_periodic(void); /* at ${frequency} Hz */

/* Self-test mismatches at start-up. The module neither flies nor lets anybody arm unless it is 0. */
uint32_t ${name}_module_mismatches(void);

/* Whether the network flies now; and its commands: ${"rpm, in the order of the board's motors" if rpm else "p, q, r in rad/s and specific thrust in m/s^2"}.
 * ${"Call it at the top of actuators_bebop_commit() with actuators_bebop.rpm_ref." if rpm else "Give them to the inner loop in place of the stick's."} */
bool ${name}_module_command(${command_type} command[4]);

#endif /* ${NAME}_MODULE_H */
