/* See QuadjaxPolicy.hpp. */
#include "QuadjaxPolicy.hpp"

#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

static int32_t policy_words[QUADJAX_POLICY_BYTES / 4];

QuadjaxPolicy::QuadjaxPolicy() :
	ScheduledWorkItem(MODULE_NAME, px4::wq_configurations::rate_ctrl)
{
}

bool QuadjaxPolicy::init()
{
	_refused = load();

	if (_refused != nullptr) {
		PX4_ERR("policy rejected: %s", _refused);
	}

	_period_us = (_refused == nullptr) ? _pilot.policy.period_ns / 1000 : 10000;
	ScheduleOnInterval(_period_us);
	return true;
}

const char *QuadjaxPolicy::load()
{
	uint32_t bytes = 0;
	const char *wrong = read_file(&bytes);

	if (wrong == nullptr) {
		/* The period of our calls is that of the policy. */
		const qj_interface interface = {
			QJ_GIVES(QJ_EULER) | QJ_GIVES(QJ_QUATERNION) | QJ_GIVES(QJ_ROTOR_SPEED),
			QJ_GIVES(QJ_MOTOR), static_cast<uint32_t>(policy_words[kPeriodWord]), 1U
		};
		wrong = qj_pilot_load(&_pilot, policy_words, bytes, &interface);
	}

	if (wrong == nullptr && _pilot.policy.period_ns < 1000000) {
		wrong = "its time step is shorter than 1 ms";
	}

	return (wrong == nullptr) ? read_geometry() : wrong;
}

const char *QuadjaxPolicy::read_file(uint32_t *bytes)
{
	const int file = ::open(QUADJAX_POLICY_FILE, O_RDONLY);

	if (file < 0) {
		return "no file " QUADJAX_POLICY_FILE;
	}

	uint8_t *const buffer = reinterpret_cast<uint8_t *>(policy_words);
	size_t size = 0;
	ssize_t more = 1;

	while (more > 0 && size < sizeof(policy_words)) {
		more = ::read(file, buffer + size, sizeof(policy_words) - size);
		size += (more > 0) ? static_cast<size_t>(more) : 0U;
	}

	::close(file);
	*bytes = static_cast<uint32_t>(size);

	if (more < 0) {
		return "cannot be read";
	}

	return (size < sizeof(policy_words)) ? nullptr : "larger than QUADJAX_POLICY_BYTES";
}

/* PX4's motors by their place: the airframe's parameters, x to the front and y to the right. */
const char *QuadjaxPolicy::read_geometry()
{
	int32_t count = 0;
	unsigned seen = 0;
	param_get(param_find("CA_ROTOR_COUNT"), &count);

	for (unsigned i = 0; i < 4; i++) {
		char name[17];
		float x = 0.f;
		float y = 0.f;
		snprintf(name, sizeof(name), "CA_ROTOR%u_PX", i);
		param_get(param_find(name), &x);
		snprintf(name, sizeof(name), "CA_ROTOR%u_PY", i);
		param_get(param_find(name), &y);
		_place[i] = (x > 0.f) ? ((y > 0.f) ? QJ_FRONT_RIGHT : QJ_FRONT_LEFT)
			    : ((y > 0.f) ? QJ_REAR_RIGHT : QJ_REAR_LEFT);
		seen |= (x < 0.f || x > 0.f) && (y < 0.f || y > 0.f) ? 1u << _place[i] : 0u;
	}

	return (count == 4 && seen == 15u) ? nullptr : "CA_ROTOR0..3 are no quadcopter in X";
}

void QuadjaxPolicy::update_topics()
{
	_position_sub.update(&_position);
	_attitude_sub.update(&_attitude);
	_rates_sub.update(&_rates);
	_status_sub.update(&_status);
	_escs_sub.update(&_escs);
}

/* By place; false if a motor reports none. */
bool QuadjaxPolicy::read_rotor_speeds(float speed[4]) const
{
	constexpr float rad_per_s = 0.10471975511965977f; /* of one rpm */
	unsigned seen = 0;

	for (unsigned i = 0; i < esc_status_s::CONNECTED_ESC_MAX; i++) {
		const unsigned motor = static_cast<unsigned>(_escs.esc[i].actuator_function)
				       - esc_report_s::ACTUATOR_FUNCTION_MOTOR1;

		if (i < _escs.esc_count && motor < 4u) {
			speed[_place[motor]] = fabsf(static_cast<float>(_escs.esc[i].esc_rpm)) * rad_per_s;
			seen |= 1u << motor;
		}
	}

	return seen == 15u;
}

/* Whether a sample is older than kStale, or as far ahead. */
bool QuadjaxPolicy::is_stale(hrt_abstime now, hrt_abstime sample)
{
	return now > sample + kStale || sample > now + kStale;
}

/* What keeps the policy from flying, or nullptr. */
const char *QuadjaxPolicy::missing(hrt_abstime now) const
{
	float speed[4];

	if (_refused != nullptr) {
		return _refused;
	}

	if (is_stale(now, _position.timestamp) || !_position.xy_valid || !_position.z_valid
	    || !_position.v_xy_valid || !_position.v_z_valid) {
		return "no local position";
	}

	if (is_stale(now, _attitude.timestamp)) {
		return "no attitude";
	}

	if (is_stale(now, _rates.timestamp)) {
		return "no body rates";
	}

	if (qj_observes(&_pilot.policy, QJ_ROTOR_SPEED)
	    && (is_stale(now, _escs.timestamp) || !read_rotor_speeds(speed))) {
		return "no rotor speeds";
	}

	return nullptr;
}

void QuadjaxPolicy::register_mode(hrt_abstime now)
{
	register_ext_component_reply_s reply{};

	while (_reply_sub.update(&reply)) {
		if (reply.request_id == kRequest && reply.success) {
			_check_id = reply.arming_check_id;
			_mode_id = reply.mode_id;
			_registered = true;
			configure_mode();
			return;
		}
	}

	if (_requested == 0 || now > _requested + kRetry) {
		register_ext_component_request_s request{};
		request.timestamp = now;
		request.request_id = kRequest;
		request.px4_ros2_api_version = 1;
		request.register_arming_check = true;
		request.register_mode = true;
		strncpy(request.name, "Quadjax policy", sizeof(request.name) - 1);
		_register_pub.publish(request);
		_requested = now;
	}
}

void QuadjaxPolicy::unregister_mode()
{
	unregister_ext_component_s request{};
	request.timestamp = hrt_absolute_time();
	request.arming_check_id = _check_id;
	request.mode_id = _mode_id;
	strncpy(request.name, "Quadjax policy", sizeof(request.name) - 1);
	_unregister_pub.publish(request);
}

/* Direct motor setpoints: no controller and no allocation of PX4's. */
void QuadjaxPolicy::configure_mode()
{
	vehicle_control_mode_s config{};
	config.timestamp = hrt_absolute_time();
	config.source_id = _mode_id;
	config.flag_multicopter_position_control_enabled = false;
	config.flag_control_position_enabled = false;
	config.flag_control_velocity_enabled = false;
	config.flag_control_altitude_enabled = false;
	config.flag_control_climb_rate_enabled = false;
	config.flag_control_acceleration_enabled = false;
	config.flag_control_attitude_enabled = false;
	config.flag_control_rates_enabled = false;
	config.flag_control_allocation_enabled = false;
	config.flag_control_termination_enabled = false;
	_config_pub.publish(config);
}

/* Commander asks a few times a second. Without a good answer it neither arms in the mode nor stays in
 * it. */
void QuadjaxPolicy::reply_to_arming_check(hrt_abstime now)
{
	arming_check_request_s request{};

	while (_request_sub.update(&request)) {
		arming_check_reply_s reply{};
		reply.timestamp = now;
		reply.request_id = request.request_id;
		reply.registration_id = _check_id;
		reply.health_component_index = arming_check_reply_s::HEALTH_COMPONENT_INDEX_NONE;
		reply.num_events = 0;
		reply.can_arm_and_run = missing(now) == nullptr;
		reply.mode_req_angular_velocity = true;
		reply.mode_req_attitude = true;
		reply.mode_req_local_position = true;
		reply.mode_req_local_alt = true;
		_check_pub.publish(reply);
	}
}

qj_vehicle QuadjaxPolicy::vehicle() const
{
	qj_vehicle found{};
	found.time_us = static_cast<uint32_t>(_rates.timestamp);
	const float position[3] = {_position.x, _position.y, _position.z};
	const float velocity[3] = {_position.vx, _position.vy, _position.vz};
	memcpy(found.position, position, sizeof(position));
	memcpy(found.velocity, velocity, sizeof(velocity));
	memcpy(found.quaternion, _attitude.q, sizeof(found.quaternion));
	memcpy(found.rates, _rates.xyz, sizeof(found.rates));
	qj_euler_of(found.quaternion, found.euler);
	read_rotor_speeds(found.rotor_speed);
	return found;
}

/* From a place to PX4's number. Each is within 0 .. 1 by the policy's proof; a negative number or NaN
 * would stop a motor. */
void QuadjaxPolicy::publish(const float by_place[4])
{
	actuator_motors_s motors{};
	motors.timestamp = hrt_absolute_time();
	motors.timestamp_sample = _rates.timestamp_sample;

	for (unsigned i = 0; i < actuator_motors_s::NUM_CONTROLS; i++) {
		motors.control[i] = (i < 4) ? by_place[_place[i]] : NAN;
	}

	_motors_pub.publish(motors);
}

/* Without all that the policy observes the pilot holds the last commands for a while, then idles. */
void QuadjaxPolicy::fly(hrt_abstime now)
{
	const bool complete = missing(now) == nullptr;
	const qj_vehicle seen = vehicle();
	float motors[4];
	(void)qj_pilot_step(&_pilot, static_cast<uint32_t>(now), complete ? &seen : nullptr, motors);
	publish(motors);
}

void QuadjaxPolicy::Run()
{
	if (should_exit()) {
		if (_registered) {
			unregister_mode();
		}

		ScheduleClear();
		exit_and_cleanup();
		return;
	}

	const hrt_abstime now = hrt_absolute_time();
	update_topics();

	if (_refused != nullptr) {
		return; /* a mode that does not exist cannot be entered */
	}

	if (!_registered) {
		register_mode(now);
		return;
	}

	reply_to_arming_check(now);
	const bool active = _status.nav_state == static_cast<uint8_t>(_mode_id)
			    && _status.arming_state == vehicle_status_s::ARMING_STATE_ARMED;

	if (active && !_active) {
		qj_pilot_reset(&_pilot);
	}

	_active = active;

	if (_active) {
		fly(now);
	}
}

int QuadjaxPolicy::task_spawn(int argc, char *argv[])
{
	(void)argc;
	(void)argv;
	QuadjaxPolicy *const instance = new QuadjaxPolicy();

	if (instance != nullptr) {
		_object.store(instance);
		_task_id = task_id_is_work_queue;

		if (instance->init()) {
			return PX4_OK;
		}
	}

	PX4_ERR("alloc failed");
	delete instance;
	_object.store(nullptr);
	_task_id = -1;
	return PX4_ERROR;
}

int QuadjaxPolicy::custom_command(int argc, char *argv[])
{
	(void)argc;
	(void)argv;
	return print_usage("unknown command");
}

int QuadjaxPolicy::print_status()
{
	const char *const wrong = missing(hrt_absolute_time());
	const qj_counters &counters = _pilot.counters;
	PX4_INFO("policy %s, %s", (_refused == nullptr) ? "loaded" : "none",
		 (wrong == nullptr) ? "ready" : wrong);
	PX4_INFO("mode %d, %s, target gate %u, passed %u, missed %u", _mode_id,
		 _active ? "flying" : "not flying", static_cast<unsigned>(_pilot.race.target),
		 static_cast<unsigned>(_pilot.race.passed), static_cast<unsigned>(_pilot.race.missed));
	PX4_INFO("steps %u, with NaN %u, clipped %u, outside %u",
		 static_cast<unsigned>(counters.steps), static_cast<unsigned>(counters.nan_steps),
		 static_cast<unsigned>(counters.clipped_steps),
		 static_cast<unsigned>(counters.outside_steps));
	return 0;
}

int QuadjaxPolicy::print_usage(const char *reason)
{
	if (reason != nullptr) {
		PX4_WARN("%s\n", reason);
	}

	PRINT_MODULE_DESCRIPTION("Flies a quadjax policy from " QUADJAX_POLICY_FILE);
	PRINT_MODULE_USAGE_NAME("quadjax_policy", "controller");
	PRINT_MODULE_USAGE_COMMAND("start");
	PRINT_MODULE_USAGE_DEFAULT_COMMANDS();
	return 0;
}

extern "C" __EXPORT int quadjax_policy_main(int argc, char *argv[]);

extern "C" int quadjax_policy_main(int argc, char *argv[])
{
	return QuadjaxPolicy::main(argc, argv);
}
