/* The pilot of an exported policy behind the messages: what an autopilot's glue is on a drone. */
#include "qj_pilot.h"
#include "quadjax_words.h"
#include "message.h"

#define RPM_PER_RAD_S 9.549296585513721F

static const qj_interface interface = {INTERFACE_GIVES, INTERFACE_KINDS, INTERFACE_CALL_NS,
                                       INTERFACE_EVERY_CALL};
static qj_pilot pilot;
static qj_counters before;

static void copy(float *to, const float *from, int count) {
  for (int i = 0; i < count; ++i) {
    to[i] = from[i];
  }
}

const char *sil_load(void) {
  return qj_pilot_load(&pilot, quadjax_words, sizeof(quadjax_words), &interface);
}

uint32_t sil_own_estimator(void) { return pilot.own_estimator; }

void sil_begin(void) {
  before = pilot.counters;
  pilot.estimator.started = 0U;
  pilot.battery.started = 0U;
  qj_pilot_reset(&pilot);
}

void sil_step(const sil_state *from, sil_command *to) {
  qj_vehicle vehicle;
  const double time_s = from->header.time_s;
  const uint32_t timed = (time_s >= 0.0) && (time_s < 1e12); /* a number that an integer holds */
  vehicle.time_us = timed ? (uint32_t)(uint64_t)(time_s * 1e6 + 0.5) : pilot.state_us;
  copy(vehicle.position, from->position_ned_m, 3);
  copy(vehicle.velocity, from->velocity_ned_m_s, 3);
  copy(vehicle.euler, from->attitude_rpy_rad, 3);
  copy(vehicle.quaternion, from->quaternion_wxyz, 4);
  copy(vehicle.rates, from->rates_frd_rad_s, 3);
  copy(vehicle.rotor_speed, from->rotor_speed_rad_s, 4);
  for (int i = 0; i < 4; ++i) {
    vehicle.rotor_rpm[i] = from->rotor_speed_rad_s[i] * RPM_PER_RAD_S;
    vehicle.others_command[i] = pilot.command[i];
  }
  vehicle.thrust[0] = from->thrust_m_s2;
  copy(vehicle.moment_ext, from->moment_frd_n_m, 3);
  copy(vehicle.force_ext, from->force_frd_m_s2, 3);
  copy(vehicle.gyro, from->gyro_frd_rad_s, 3);
  copy(vehicle.specific_force, from->specific_force_frd_m_s2, 3);
  copy(vehicle.body_velocity, from->velocity_frd_m_s, 3);
  (void)qj_pilot_step(&pilot, vehicle.time_us, timed ? &vehicle : 0, to->command);
  for (int i = 0; i < 4; ++i) {
    to->command[i] = (pilot.policy.kind == QJ_RPM) ? to->command[i] / RPM_PER_RAD_S : to->command[i];
  }
  to->target_gate = pilot.race.target;
  to->nan_steps = pilot.counters.nan_steps - before.nan_steps;
  to->clipped_steps = pilot.counters.clipped_steps - before.clipped_steps;
  to->outside_steps = pilot.counters.outside_steps - before.outside_steps;
}
