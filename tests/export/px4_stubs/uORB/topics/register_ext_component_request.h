#pragma once
#include <stdint.h>
#include "../uORB_stub.h"
struct register_ext_component_request_s {
	uint64_t timestamp;
	uint64_t request_id;
	char name[25];
	uint16_t px4_ros2_api_version;
	bool register_arming_check;
	bool register_mode;
	bool register_mode_executor;
};
ORB_DECLARE(register_ext_component_request);
