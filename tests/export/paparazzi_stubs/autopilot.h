#ifndef AUTOPILOT_H
#define AUTOPILOT_H
#include <stdbool.h>
#include <stdint.h>
#define AP_MODE_MODULE 15
#define AC_ID 1
uint8_t autopilot_get_mode(void);
bool autopilot_set_motors_on(bool on);
#endif
