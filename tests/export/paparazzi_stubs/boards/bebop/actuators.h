#ifndef BOARDS_BEBOP_ACTUATORS_H
#define BOARDS_BEBOP_ACTUATORS_H
#include <stdint.h>
struct ActuatorsBebop { uint16_t rpm_ref[4]; uint16_t rpm_obs[4]; };
extern struct ActuatorsBebop actuators_bebop;
#endif
