#pragma once
#include <stdint.h>
#include "../uORB_stub.h"
struct actuator_motors_s {
	static constexpr unsigned NUM_CONTROLS = 12;
	uint64_t timestamp;
	uint64_t timestamp_sample;
	uint16_t reversible_flags;
	float control[12];
};
ORB_DECLARE(actuator_motors);
