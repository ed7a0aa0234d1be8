#pragma once
#include <stdint.h>
#include "../uORB_stub.h"
struct vehicle_attitude_s {
	uint64_t timestamp;
	uint64_t timestamp_sample;
	float q[4];
};
ORB_DECLARE(vehicle_attitude);
