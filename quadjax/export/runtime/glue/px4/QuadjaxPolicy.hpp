/*
 * A PX4 module that flies a quadjax policy (.qjp) from the SD card in a mode of its own, with direct
 * motor setpoints. NOT TESTED ON HARDWARE OR IN PX4'S SIMULATION: compiled against stand-ins of
 * PX4's headers.
 */
#pragma once

#include <drivers/drv_hrt.h>
#include <parameters/param.h>
#include <px4_platform_common/log.h>
#include <px4_platform_common/module.h>
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <uORB/Publication.hpp>
#include <uORB/Subscription.hpp>
#include <uORB/topics/actuator_motors.h>
#include <uORB/topics/arming_check_reply.h>
#include <uORB/topics/arming_check_request.h>
#include <uORB/topics/esc_status.h>
#include <uORB/topics/register_ext_component_reply.h>
#include <uORB/topics/register_ext_component_request.h>
#include <uORB/topics/unregister_ext_component.h>
#include <uORB/topics/vehicle_angular_velocity.h>
#include <uORB/topics/vehicle_attitude.h>
#include <uORB/topics/vehicle_control_mode.h>
#include <uORB/topics/vehicle_local_position.h>
#include <uORB/topics/vehicle_status.h>

#include "qj_pilot.h"

#ifndef QUADJAX_POLICY_FILE
#define QUADJAX_POLICY_FILE "/fs/microsd/quadjax/policy.qjp"
#endif
#ifndef QUADJAX_POLICY_BYTES
#define QUADJAX_POLICY_BYTES 196608 /* the largest file, static memory */
#endif

class QuadjaxPolicy : public ModuleBase<QuadjaxPolicy>, public px4::ScheduledWorkItem
{
public:
	QuadjaxPolicy();
	~QuadjaxPolicy() override = default;

	static int task_spawn(int argc, char *argv[]);
	static int custom_command(int argc, char *argv[]);
	static int print_usage(const char *reason = nullptr);
	int print_status() override;

	/* Loads the policy, and runs every step of it from then on. */
	bool init();

private:
	/* After this time without a new sample, what a topic says is not used. */
	static constexpr hrt_abstime kStale = 100000; /* us */
	static constexpr unsigned kPeriodWord = 14; /* of a step, in the header of the file */
	static constexpr hrt_abstime kRetry = 1000000; /* us, between requests to register */
	static constexpr uint64_t kRequest = 0x51A90F1Eu; /* identifies our registration */

	void Run() override;

	const char *load();
	const char *read_file(uint32_t *bytes);
	const char *read_geometry();
	void update_topics();
	bool read_rotor_speeds(float speed[4]) const;
	static bool is_stale(hrt_abstime now, hrt_abstime sample);
	const char *missing(hrt_abstime now) const;
	void register_mode(hrt_abstime now);
	void unregister_mode();
	void configure_mode();
	void reply_to_arming_check(hrt_abstime now);
	void fly(hrt_abstime now);
	qj_vehicle vehicle() const;
	void publish(const float by_place[4]);

	qj_pilot _pilot{};
	const char *_refused{"not loaded"};
	uint8_t _place[4]{}; /* of PX4's motors 1 to 4 */
	uint32_t _period_us{10000};

	bool _registered{false};
	bool _active{false};
	int8_t _mode_id{-1};
	int8_t _check_id{-1};
	hrt_abstime _requested{0};

	vehicle_local_position_s _position{};
	vehicle_attitude_s _attitude{};
	vehicle_angular_velocity_s _rates{};
	vehicle_status_s _status{};
	esc_status_s _escs{};

	uORB::Subscription _position_sub{ORB_ID(vehicle_local_position)};
	uORB::Subscription _attitude_sub{ORB_ID(vehicle_attitude)};
	uORB::Subscription _rates_sub{ORB_ID(vehicle_angular_velocity)};
	uORB::Subscription _status_sub{ORB_ID(vehicle_status)};
	uORB::Subscription _escs_sub{ORB_ID(esc_status)};
	uORB::Subscription _reply_sub{ORB_ID(register_ext_component_reply)};
	uORB::Subscription _request_sub{ORB_ID(arming_check_request)};

	uORB::Publication<actuator_motors_s> _motors_pub{ORB_ID(actuator_motors)};
	uORB::Publication<arming_check_reply_s> _check_pub{ORB_ID(arming_check_reply)};
	uORB::Publication<register_ext_component_request_s> _register_pub{
		ORB_ID(register_ext_component_request)};
	uORB::Publication<unregister_ext_component_s> _unregister_pub{
		ORB_ID(unregister_ext_component)};
	uORB::Publication<vehicle_control_mode_s> _config_pub{ORB_ID(config_control_setpoints)};
};
