/* A stand-in for PX4 around the module: its messages, its Commander, and its scheduler. */
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "firmware.h"

#define MODULE_NAME "quadjax_policy"
#define PX4_OK 0
#define PX4_ERROR (-1)
#define __EXPORT
#define PX4_INFO(...) (printf(__VA_ARGS__), printf("\n"))
#define PX4_WARN(...) PX4_INFO(__VA_ARGS__)
#define PX4_ERR(...) (void)sizeof(printf(__VA_ARGS__))
#define PRINT_MODULE_DESCRIPTION(text) (void)(text)
#define PRINT_MODULE_USAGE_NAME(name, category) (void)(name)
#define PRINT_MODULE_USAGE_COMMAND(name) (void)(name)
#define PRINT_MODULE_USAGE_DEFAULT_COMMANDS() (void)0
#define ORB_ID(name) (&topic_##name)

typedef uint64_t hrt_abstime;
typedef uintptr_t param_t;

/* ---- messages ---------------------------------------------------------------------------------- */

struct actuator_motors_s {
	static constexpr unsigned NUM_CONTROLS = 12;
	uint64_t timestamp, timestamp_sample;
	float control[12];
};
struct arming_check_reply_s {
	static constexpr uint8_t HEALTH_COMPONENT_INDEX_NONE = 0;
	uint64_t timestamp;
	uint8_t request_id, registration_id, health_component_index, num_events;
	bool can_arm_and_run;
	bool mode_req_angular_velocity, mode_req_attitude, mode_req_local_alt, mode_req_local_position;
};
struct arming_check_request_s {
	uint64_t timestamp;
	uint8_t request_id;
};
struct esc_report_s {
	static constexpr uint8_t ACTUATOR_FUNCTION_MOTOR1 = 101;
	int32_t esc_rpm;
	uint8_t actuator_function;
};
struct esc_status_s {
	static constexpr uint8_t CONNECTED_ESC_MAX = 8;
	uint64_t timestamp;
	uint8_t esc_count;
	esc_report_s esc[8];
};
struct register_ext_component_reply_s {
	uint64_t request_id;
	bool success;
	int8_t arming_check_id, mode_id;
};
struct register_ext_component_request_s {
	uint64_t timestamp, request_id;
	char name[25];
	uint16_t px4_ros2_api_version;
	bool register_arming_check, register_mode;
};
struct unregister_ext_component_s {
	uint64_t timestamp;
	char name[25];
	int8_t arming_check_id, mode_id;
};
struct vehicle_angular_velocity_s {
	uint64_t timestamp, timestamp_sample;
	float xyz[3];
};
struct vehicle_attitude_s {
	uint64_t timestamp;
	float q[4];
};
struct vehicle_control_mode_s {
	uint64_t timestamp;
	bool flag_multicopter_position_control_enabled, flag_control_position_enabled;
	bool flag_control_velocity_enabled, flag_control_altitude_enabled;
	bool flag_control_climb_rate_enabled, flag_control_acceleration_enabled;
	bool flag_control_attitude_enabled, flag_control_rates_enabled;
	bool flag_control_allocation_enabled, flag_control_termination_enabled;
	int8_t source_id;
};
struct vehicle_local_position_s {
	uint64_t timestamp;
	bool xy_valid, z_valid, v_xy_valid, v_z_valid;
	float x, y, z, vx, vy, vz;
};
struct vehicle_status_s {
	static constexpr uint8_t ARMING_STATE_ARMED = 2;
	uint8_t arming_state, nav_state;
};

/* ---- topics, parameters, scheduler ------------------------------------------------------------- */

struct orb_metadata { /* one message of a topic, and how often it was published */
	void *message;
	size_t size;
	unsigned generation;
};

#define TOPIC(name, type) static type message_##name; \
	static orb_metadata topic_##name{&message_##name, sizeof(type), 0};
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

static hrt_abstime clock_us = 100000000;
static const float rotor_x[4] = {1.f, -1.f, 1.f, -1.f};
static const float rotor_y[4] = {1.f, -1.f, -1.f, 1.f};
extern "C" { /* for tests */
unsigned px4_lost = 0;     /* bit 0: no position, 1: no rotor speeds, 2: no attitude, 3: rates of the future */
unsigned px4_geometry = 0; /* 1: the airframe is no X */
unsigned px4_interval = 0; /* us between two calls */
}

static hrt_abstime hrt_absolute_time() { return clock_us; }

static param_t param_find(const char *name)
{
	return (strcmp(name, "CA_ROTOR_COUNT") == 0) ? 100 :
	       static_cast<param_t>(name[8] - '0') * 2 + (name[11] == 'Y');
}

static int param_get(param_t param, int32_t *value)
{
	*value = (param == 100) ? 4 : 0;
	return 0;
}

static int param_get(param_t param, float *value)
{
	*value = (param % 2) ? rotor_y[param / 2 % 4] : rotor_x[param / 2 % 4];
	*value = (px4_geometry != 0) ? 1.f : *value;
	return 0;
}

namespace uORB
{
template <typename T> class Publication
{
public:
	explicit Publication(orb_metadata *meta) : _meta(meta) {}
	bool publish(const T &message)
	{
		memcpy(_meta->message, &message, sizeof(T));
		_meta->generation++;
		return true;
	}
private:
	orb_metadata *_meta;
};

class Subscription
{
public:
	explicit Subscription(orb_metadata *meta) : _meta(meta) {}
	bool update(void *to)
	{
		const bool fresh = _seen != _meta->generation;
		memcpy(to, _meta->message, fresh ? _meta->size : 0);
		_seen = _meta->generation;
		return fresh;
	}
private:
	orb_metadata *_meta;
	unsigned _seen{0};
};
}

namespace px4
{
struct wq_config_t {};
namespace wq_configurations
{
static constexpr wq_config_t rate_ctrl{};
}
class ScheduledWorkItem
{
public:
	ScheduledWorkItem(const char *, const wq_config_t &) {}
	virtual ~ScheduledWorkItem() = default;
	void ScheduleOnInterval(uint32_t us) { px4_interval = us; }
	void ScheduleClear() { px4_interval = 0; }
	virtual void Run() {}
};
}

class QuadjaxPolicy;
static struct {
	QuadjaxPolicy *value;
	void store(QuadjaxPolicy *to) { value = to; }
	QuadjaxPolicy *load() const { return value; }
} _object;
static int _task_id;
static constexpr int task_id_is_work_queue = -2;

template <class T> class ModuleBase
{
public:
	virtual ~ModuleBase() = default;
	virtual int print_status() { return 0; }
	static int main(int argc, char *argv[]) { return T::task_spawn(argc, argv); }
	bool stop{false};
protected:
	bool should_exit() const { return stop; }
	static void exit_and_cleanup() { delete static_cast<T *>(_object.load()); _object.store(nullptr); }
};

#define private public
#include "QuadjaxPolicy.cpp"
#undef private

/* The only object of C++ that is made: the module. */
alignas(16) static unsigned char memory[sizeof(QuadjaxPolicy)];
void *operator new(size_t) { return memory; }
void operator delete(void *) noexcept {}
void operator delete(void *, size_t) noexcept {}

static QuadjaxPolicy *module() { return reinterpret_cast<QuadjaxPolicy *>(memory); }

/* Commander registers the mode with the number 23. */
extern "C" const char *firmware_start(void)
{
	quadjax_policy_main(0, nullptr);
	module()->Run();

	if (topic_register_ext_component_request.generation != 0) {
		const uint64_t request = message_register_ext_component_request.request_id;
		const register_ext_component_reply_s reply{request, true, 5, 23};
		uORB::Publication<register_ext_component_reply_s>(ORB_ID(register_ext_component_reply)).publish(reply);
		module()->Run();
	}

	return module()->_refused;
}

static void set_state(const qj_vehicle &v, hrt_abstime seen)
{
	const hrt_abstime old = clock_us - 10000000;
	const float *const p = v.position;
	const float *const s = v.velocity;
	message_vehicle_local_position = {(px4_lost & 1u) ? old : seen, true, true, true, true,
					  p[0], p[1], p[2], s[0], s[1], s[2]
					 };
	message_vehicle_attitude.timestamp = (px4_lost & 4u) ? old : seen;
	memcpy(message_vehicle_attitude.q, v.quaternion, sizeof(v.quaternion));
	message_vehicle_angular_velocity.timestamp = (px4_lost & 8u) ? clock_us + 200000 : seen;
	memcpy(message_vehicle_angular_velocity.xyz, v.rates, sizeof(v.rates));
	message_esc_status.timestamp = (px4_lost & 2u) ? old : seen;
	message_esc_status.esc_count = 4;

	for (unsigned i = 0; i < 4; i++) {
		const float speed = v.rotor_speed[module()->_place[i]] * 9.549297f;
		message_esc_status.esc[i].esc_rpm = (fabsf(speed) < 1e9f) ? static_cast<int32_t>(lrintf(speed)) : 0;
		message_esc_status.esc[i].actuator_function = static_cast<uint8_t>(101 + i);
	}

	topic_vehicle_local_position.generation++;
	topic_vehicle_attitude.generation++;
	topic_vehicle_angular_velocity.generation++;
	topic_esc_status.generation++;
}

extern "C" uint32_t firmware_call(uint32_t now_us, const qj_vehicle *vehicle, uint32_t flies, float command[QJ_COMMANDS])
{
	static uint32_t before_us;
	clock_us += (now_us - before_us < 1000000u) ? now_us - before_us : 10000u;
	before_us = now_us;

	if (vehicle != nullptr) {
		set_state(*vehicle, clock_us - (now_us - vehicle->time_us));
	}

	message_vehicle_status = {static_cast<uint8_t>(flies ? 2 : 1), static_cast<uint8_t>(flies ? 23 : 2)};
	topic_vehicle_status.generation++;
	message_arming_check_request.request_id++;
	topic_arming_check_request.generation++;
	const unsigned published = topic_actuator_motors.generation;
	module()->Run();

	for (unsigned i = 0; i < 4; i++) {
		command[module()->_place[i]] = (topic_actuator_motors.generation != published)
					       ? message_actuator_motors.control[i] : 0.f;
	}

	return message_arming_check_reply.can_arm_and_run
	       && message_arming_check_reply.request_id == message_arming_check_request.request_id;
}

extern "C" qj_pilot *firmware_pilot(void) { return &module()->_pilot; }

/* Whether the mode takes the motors from PX4's controllers, and ends with the module. */
extern "C" unsigned px4_mode(void)
{
	const vehicle_control_mode_s &c = message_config_control_setpoints;
	const bool taken = c.source_id == 23 && !c.flag_control_allocation_enabled && !c.flag_control_rates_enabled;
	module()->stop = true;
	module()->Run();
	return taken && topic_unregister_ext_component.generation == 1;
}
