#pragma once
#include <stdint.h>
#include "../uORB_stub.h"
struct vehicle_angular_velocity_s {
	uint64_t timestamp;
	uint64_t timestamp_sample;
	float xyz[3];
};
ORB_DECLARE(vehicle_angular_velocity);
