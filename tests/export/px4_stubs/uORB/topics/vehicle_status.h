#pragma once
#include <stdint.h>
#include "../uORB_stub.h"
struct vehicle_status_s {
	static constexpr uint8_t ARMING_STATE_ARMED = 2;
	uint64_t timestamp;
	uint8_t arming_state;
	uint8_t nav_state;
};
ORB_DECLARE(vehicle_status);
