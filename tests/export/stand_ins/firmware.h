/* Stand-ins for the firmware around the glue of an autopilot. Each has what the glue uses of the
 * firmware, as this project understands it, and calls the glue: no glue was built in its real
 * firmware. */
#ifndef FIRMWARE_H
#define FIRMWARE_H

#include "qj_pilot.h"

/* Start-up. Returns 0, or why the policy does not fly. */
const char *firmware_start(void);

/* One call of the glue. vehicle: the newest state, of which the glue reads what the autopilot
 * measures; 0: it is lost. flies: whether the mode of the policy is on. command: to the motors in
 * the order of the policy; or rates, and thrust of the inner loop in autopilot units; zeros if the
 * policy commands nothing. Returns whether the autopilot allows arming. */
uint32_t firmware_call(uint32_t now_us, const qj_vehicle *vehicle, uint32_t flies,
                       float command[QJ_COMMANDS]);

/* The pilot in the glue. */
qj_pilot *firmware_pilot(void);

#endif /* FIRMWARE_H */
