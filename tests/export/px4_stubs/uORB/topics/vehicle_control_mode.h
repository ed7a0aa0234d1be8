#pragma once
#include <stdint.h>
#include "../uORB_stub.h"
struct vehicle_control_mode_s {
	uint64_t timestamp;
	bool flag_multicopter_position_control_enabled;
	bool flag_control_position_enabled;
	bool flag_control_velocity_enabled;
	bool flag_control_altitude_enabled;
	bool flag_control_climb_rate_enabled;
	bool flag_control_acceleration_enabled;
	bool flag_control_attitude_enabled;
	bool flag_control_rates_enabled;
	bool flag_control_allocation_enabled;
	bool flag_control_termination_enabled;
	int8_t source_id;
};
ORB_DECLARE(config_control_setpoints);
