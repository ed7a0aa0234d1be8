/* Calls the firmware at its own rate, between the states of a simulated drone. */
#include "firmware.h"

#define RPM_PER_RAD_S 9.549296585513721F
#define CALL_S (1e-9 * (double)FIRMWARE_CALL_NS)
#define LONGEST 100000U /* calls without a state */

const char *sil_load(void);       /* 0, or why the policy cannot fly */
uint32_t sil_own_estimator(void); /* whether the policy's estimator of disturbances runs */
void sil_begin(void);             /* the next state starts a race */
void sil_step(double time_s, const qj_vehicle *state, float to[QJ_COMMANDS]);
void sil_counts(uint32_t steps[3]); /* of this race: with NaN, clipped, outside */

static qj_vehicle newest;
static qj_counters before;
static float command[QJ_COMMANDS];
static uint32_t call; /* number of the last call in this race */
static uint32_t begun;

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

/* Make the calls up to the time of a state; only the last of them has this state, of which the rpm and
 * the autopilot's own commands are set here. Commanded rotor speeds are in rad/s. */
void sil_step(double time_s, const qj_vehicle *state, float to[QJ_COMMANDS]) {
  const double calls = time_s / CALL_S + 1e-3;
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
  newest = *state;
  newest.time_us = time_of(due);
  for (int i = 0; i < QJ_COMMANDS; ++i) {
    newest.rotor_rpm[i] = state->rotor_speed[i] * RPM_PER_RAD_S;
    newest.others_command[i] = pilot->command[i];
  }
  if (call != due) {
    (void)firmware_call(newest.time_us, &newest, 1U, command);
  }
  call = due;
  for (int i = 0; i < QJ_COMMANDS; ++i) {
    to[i] = (pilot->policy.kind == QJ_RPM) ? command[i] / RPM_PER_RAD_S : command[i];
  }
}

void sil_counts(uint32_t steps[3]) {
  const qj_counters *const now = &firmware_pilot()->counters;
  steps[0] = now->nan_steps - before.nan_steps;
  steps[1] = now->clipped_steps - before.clipped_steps;
  steps[2] = now->outside_steps - before.outside_steps;
}
