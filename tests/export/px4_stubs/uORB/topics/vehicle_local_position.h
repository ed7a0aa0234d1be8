#pragma once
#include <stdint.h>
#include "../uORB_stub.h"
struct vehicle_local_position_s {
	uint64_t timestamp;
	uint64_t timestamp_sample;
	bool xy_valid;
	bool z_valid;
	bool v_xy_valid;
	bool v_z_valid;
	float x;
	float y;
	float z;
	float vx;
	float vy;
	float vz;
};
ORB_DECLARE(vehicle_local_position);
