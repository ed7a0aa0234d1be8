#pragma once
#include <stdint.h>
#include "../uORB_stub.h"
struct esc_report_s {
	static constexpr uint8_t ACTUATOR_FUNCTION_MOTOR1 = 101;
	uint64_t timestamp;
	int32_t esc_rpm;
	uint8_t actuator_function;
};
struct esc_status_s {
	static constexpr uint8_t CONNECTED_ESC_MAX = 8;
	uint64_t timestamp;
	uint8_t esc_count;
	esc_report_s esc[8];
};
ORB_DECLARE(esc_status);
