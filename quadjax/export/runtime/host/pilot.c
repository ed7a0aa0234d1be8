/* Firmware that calls the pilot itself: what an autopilot's glue is on a drone. */
#include "firmware.h"
#include "quadjax_words.h"

static qj_pilot pilot;

const char *firmware_start(void) {
  static const qj_interface interface = {INTERFACE_GIVES, INTERFACE_KINDS, INTERFACE_CALL_NS};
  return qj_pilot_load(&pilot, quadjax_words, sizeof(quadjax_words), &interface);
}

uint32_t firmware_call(uint32_t now_us, const qj_vehicle *vehicle, uint32_t flies,
                       float command[QJ_COMMANDS]) {
  if (flies != 0U) {
    (void)qj_pilot_step(&pilot, now_us, vehicle, command);
  } else {
    for (uint32_t i = 0U; i < QJ_COMMANDS; ++i) {
      command[i] = 0.0F;
    }
    qj_pilot_wait(&pilot, vehicle);
  }
  return pilot.usable;
}

qj_pilot *firmware_pilot(void) { return &pilot; }
