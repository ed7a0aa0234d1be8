/* The stand-ins' state, and what the tests call. */
#include <math.h>
#include <stdlib.h>

#include "QuadjaxPolicy.hpp"

extern "C" int quadjax_policy_main(int argc, char *argv[]);

#define TOPIC(name, type) static type message_##name; \
	extern "C" { orb_metadata stub_orb_##name{&message_##name, sizeof(type), 0}; }
TOPIC(actuator_motors, actuator_motors_s)
TOPIC(arming_check_reply, arming_check_reply_s)
TOPIC(arming_check_request, arming_check_request_s)
TOPIC(register_ext_component_reply, register_ext_component_reply_s)
TOPIC(register_ext_component_request, register_ext_component_request_s)
TOPIC(unregister_ext_component, unregister_ext_component_s)
TOPIC(vehicle_angular_velocity, vehicle_angular_velocity_s)
TOPIC(vehicle_attitude, vehicle_attitude_s)
TOPIC(vehicle_local_position, vehicle_local_position_s)
TOPIC(vehicle_status, vehicle_status_s)
TOPIC(config_control_setpoints, vehicle_control_mode_s)
TOPIC(esc_status, esc_status_s)

static hrt_abstime now = 100000000;
static float rotor_x[4] = {1.f, -1.f, 1.f, -1.f};
static float rotor_y[4] = {1.f, -1.f, -1.f, 1.f};

hrt_abstime hrt_absolute_time() { return now; }

param_t param_find(const char *name)
{
	if (strcmp(name, "CA_ROTOR_COUNT") == 0) {
		return 100;
	}

	return static_cast<param_t>(name[8] - '0') * 2 + (name[11] == 'Y');
}

int param_get(param_t param, void *value)
{
	const int32_t four = 4;
	const float *const place = (param % 2) ? &rotor_y[param / 2 % 4] : &rotor_x[param / 2 % 4];
	memcpy(value, (param == 100) ? static_cast<const void *>(&four) : place, 4);
	return 0;
}

/* Registered by a Commander of ours, with the mode of number 23. */
extern "C" int stub_start(int geometry)
{
	if (geometry == 1) {
		rotor_x[1] = 1.f;
	}

	message_register_ext_component_reply = register_ext_component_reply_s{};
	quadjax_policy_main(0, nullptr);
	QuadjaxPolicy *const module = QuadjaxPolicy::instance();
	module->stub_run();

	if (stub_orb_register_ext_component_request.generation == 0) {
		return 1;
	}

	register_ext_component_reply_s reply{};
	reply.request_id = message_register_ext_component_request.request_id;
	reply.success = true;
	reply.arming_check_id = 5;
	reply.mode_id = 23;
	uORB::Publication<register_ext_component_reply_s>(ORB_ID(register_ext_component_reply)).publish(reply);
	module->stub_run();
	return 0;
}

extern "C" unsigned stub_interval() { return QuadjaxPolicy::instance()->interval; }

/* state: position, velocity, quaternion, rates, rotor speeds of PX4's motors; lost: bit 0 the
 * position, 1 the rotor speeds, 2 the attitude; 3: only the rates are new; 4: the rates are of the future. */
extern "C" void stub_step(const float *state, int armed, unsigned lost, float *motors, int *ready)
{
	const hrt_abstime old = now - 10 * 1000000;
	now += 10000;
	static hrt_abstime seen;
	seen = (lost & 8u) ? seen : now;
	vehicle_local_position_s &p = message_vehicle_local_position;
	p = vehicle_local_position_s{(lost & 1u) ? old : seen, seen, true, true, true, true, state[0],
				     state[1], state[2], state[3], state[4], state[5]};
	stub_orb_vehicle_local_position.generation++;
	message_vehicle_attitude.timestamp = (lost & 4u) ? old : seen;
	memcpy(message_vehicle_attitude.q, state + 6, sizeof(float) * 4);
	stub_orb_vehicle_attitude.generation++;
	message_vehicle_angular_velocity.timestamp = (lost & 16u) ? now + 200000 : now;
	memcpy(message_vehicle_angular_velocity.xyz, state + 10, sizeof(float) * 3);
	stub_orb_vehicle_angular_velocity.generation++;
	message_esc_status.timestamp = (lost & 2u) ? old : seen;
	message_esc_status.esc_count = 4;

	for (unsigned i = 0; i < 4; i++) {
		message_esc_status.esc[i].esc_rpm = static_cast<int32_t>(lrintf(state[13 + i] * 9.549297f));
		message_esc_status.esc[i].actuator_function = static_cast<uint8_t>(101 + i);
	}

	stub_orb_esc_status.generation++;
	message_vehicle_status.nav_state = armed ? 23 : 2;
	message_vehicle_status.arming_state = armed ? 2 : 1;
	stub_orb_vehicle_status.generation++;
	message_arming_check_request.request_id++;
	stub_orb_arming_check_request.generation++;
	const unsigned before = stub_orb_actuator_motors.generation;
	QuadjaxPolicy::instance()->stub_run();

	for (unsigned i = 0; i < 4; i++) {
		motors[i] = (stub_orb_actuator_motors.generation != before) ? message_actuator_motors.control[i] : -1.f;
	}

	*ready = message_arming_check_reply.can_arm_and_run
		 && message_arming_check_reply.request_id == message_arming_check_request.request_id;
}

extern "C" int stub_configured()
{
	const vehicle_control_mode_s &c = message_config_control_setpoints;
	return c.source_id == 23 && !c.flag_control_allocation_enabled && !c.flag_control_rates_enabled;
}

extern "C" unsigned stub_stop()
{
	QuadjaxPolicy *const module = QuadjaxPolicy::instance();
	module->request_stop();
	module->stub_run();
	return stub_orb_unregister_ext_component.generation;
}
