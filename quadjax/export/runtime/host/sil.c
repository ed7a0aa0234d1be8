/* A firmware that messages call: its clock of calls, and its state at each call. */
#include "firmware.h"
#include "message.h"

#define RPM_PER_RAD_S 9.549296585513721F
#define CALL_S (1e-9 * (double)FIRMWARE_CALL_NS)
#define LONGEST 100000U /* calls without a state */

static qj_vehicle newest;
static qj_counters before;
static float command[QJ_COMMANDS];
static uint32_t call; /* number of the last call in this race */
static uint32_t begun;

static void copy(float *to, const float *from, int count) {
  for (int i = 0; i < count; ++i) {
    to[i] = from[i];
  }
}

static uint32_t time_of(uint32_t number) { return (uint32_t)(uint64_t)((double)number * CALL_S * 1e6 + 0.5); }

const char *sil_load(void) { return firmware_start(); }

uint32_t sil_own_estimator(void) { return firmware_pilot()->own_estimator; }

void sil_begin(void) {
  qj_pilot *const pilot = firmware_pilot();
  before = pilot->counters;
  pilot->estimator.started = 0U;
  pilot->battery.started = 0U;
  qj_pilot_reset(pilot);
  begun = 0U;
}

static void read_state(const sil_state *from, qj_vehicle *vehicle) {
  copy(vehicle->position, from->position_ned_m, 3);
  copy(vehicle->velocity, from->velocity_ned_m_s, 3);
  copy(vehicle->euler, from->attitude_rpy_rad, 3);
  copy(vehicle->quaternion, from->quaternion_wxyz, 4);
  copy(vehicle->rates, from->rates_frd_rad_s, 3);
  copy(vehicle->rotor_speed, from->rotor_speed_rad_s, 4);
  for (int i = 0; i < 4; ++i) {
    vehicle->rotor_rpm[i] = from->rotor_speed_rad_s[i] * RPM_PER_RAD_S;
    vehicle->others_command[i] = firmware_pilot()->command[i];
  }
  vehicle->thrust[0] = from->thrust_m_s2;
  copy(vehicle->moment_ext, from->moment_frd_n_m, 3);
  copy(vehicle->force_ext, from->force_frd_m_s2, 3);
  copy(vehicle->gyro, from->gyro_frd_rad_s, 3);
  copy(vehicle->specific_force, from->specific_force_frd_m_s2, 3);
  copy(vehicle->body_velocity, from->velocity_frd_m_s, 3);
}

/* Make the calls up to the time of a state; only the last of them has this state. */
void sil_step(const sil_state *from, sil_command *to) {
  const double calls = from->header.time_s / CALL_S + 1e-3;
  const uint32_t due = ((calls >= 0.0) && (calls < 4e9)) ? (uint32_t)calls : call;
  const qj_pilot *const pilot = firmware_pilot();
  if ((begun == 0U) || (due - call > LONGEST)) {
    call = due - 1U;
    begun = 1U;
  }
  while (call + 1U != due && call != due) {
    ++call;
    (void)firmware_call(time_of(call), &newest, 1U, command);
  }
  read_state(from, &newest);
  newest.time_us = time_of(due);
  if (call != due) {
    (void)firmware_call(newest.time_us, &newest, 1U, command);
  }
  call = due;
  for (int i = 0; i < 4; ++i) {
    to->command[i] = (pilot->policy.kind == QJ_RPM) ? command[i] / RPM_PER_RAD_S : command[i];
  }
  to->target_gate = pilot->race.target;
  to->nan_steps = pilot->counters.nan_steps - before.nan_steps;
  to->clipped_steps = pilot->counters.clipped_steps - before.clipped_steps;
  to->outside_steps = pilot->counters.outside_steps - before.outside_steps;
}
