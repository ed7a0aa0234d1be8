/* A stand-in for Paparazzi on the Bebop around the module. */
#include <stdbool.h>

#include "firmware.h"
#include "quadjax_policy.h"

#define AP_MODE_MODULE 15
#define AC_ID 1
#define PPRZ_MSG_ID_PAYLOAD_FLOAT 222
#define PREFLIGHT_CHECKS 1
#define PERIODIC_TELEMETRY 1
#define FIXED_ONE 1024.0F /* m/s^2, of an acceleration */
#define ACCEL_FLOAT_OF_BFP(a) ((float)(a) / FIXED_ONE)

struct NedCoor_f { float x, y, z; };
struct FloatQuat { float qi, qx, qy, qz; };
struct FloatRates { float p, q, r; };
struct FloatVect3 { float x, y, z; };
struct Int32Vect3 { int32_t x, y, z; };
struct FloatRMat { float m[9]; };
struct preflight_result_t { uint32_t fails; };
struct preflight_check_t { int unused; };
struct transport_tx { int unused; };
struct link_device { int unused; };
typedef struct { float o[2]; float last; float gain; } Butterworth2LowPass;
typedef void (*preflight_check_f)(struct preflight_result_t *result);
typedef void (*telemetry_cb)(struct transport_tx *trans, struct link_device *dev);

static struct { uint16_t rpm_ref[4]; uint16_t rpm_obs[4]; } actuators_bebop;
static struct NedCoor_f position, velocity;
static struct FloatQuat quaternion;
static struct FloatRates rates;
static struct Int32Vect3 acceleration;
static struct FloatVect3 velocity_of_body;
static struct FloatRMat rotation;
static uint32_t clock_us;
static uint8_t mode;
static bool motors_on = true;
static preflight_check_f preflight_check;
static telemetry_cb telemetry;
static int *DefaultPeriodic;
static struct { uint32_t last_msg_time, last_msg_ticks; } gps;
static uint32_t usec_of_cpu_ticks(uint32_t ticks) { return ticks; }
/* Of first order, for the stand-in: its gain at rest is one. */
static void init_butterworth_2_low_pass(Butterworth2LowPass *filter, float tau, float sample_time,
                                        float value) {
  filter->o[0] = value;
  filter->gain = sample_time / (tau + sample_time);
}
static float update_butterworth_2_low_pass(Butterworth2LowPass *filter, float value) {
  filter->o[0] += filter->gain * (value - filter->o[0]);
  return filter->o[0];
}
#if QUADJAX_COMMANDS_RATES
enum { COMMAND_THRUST = 3 };
#define MAX_PPRZ 9600
static int32_t stabilization_cmd[4];
static struct FloatRates inner_loop_rates;
void stabilization_indi_rate_run(struct FloatRates rates_sp, bool in_flight);
void stabilization_indi_rate_run(struct FloatRates rates_sp, bool in_flight) {
  (void)in_flight;
  inner_loop_rates = rates_sp;
}
#endif
float paparazzi_sent[12]; /* the numbers of the status message */

static uint8_t autopilot_get_mode(void) { return mode; }
static void autopilot_set_motors_on(bool on) { motors_on = on; }
static void preflight_check_register(struct preflight_check_t *check, preflight_check_f f) {
  (void)check;
  preflight_check = f;
}
static void preflight_error(struct preflight_result_t *result, const char *format, ...) {
  (void)format;
  ++result->fails;
}
static void preflight_success(struct preflight_result_t *result, const char *format, ...) {
  (void)result;
  (void)format;
}
static void register_periodic_telemetry(int *periodic, uint8_t id, telemetry_cb f) {
  (void)periodic;
  (void)id;
  telemetry = f;
}
static void pprz_msg_send_PAYLOAD_FLOAT(struct transport_tx *trans, struct link_device *dev,
                                        uint8_t id, uint8_t count, const float *values) {
  (void)trans;
  (void)dev;
  (void)id;
  for (uint32_t i = 0U; i < count; ++i) {
    paparazzi_sent[i] = values[i];
  }
}
static uint32_t get_sys_time_usec(void) { return clock_us; }
static struct NedCoor_f *stateGetPositionNed_f(void) { return &position; }
static struct NedCoor_f *stateGetSpeedNed_f(void) { return &velocity; }
static struct FloatQuat *stateGetNedToBodyQuat_f(void) { return &quaternion; }
static struct FloatRates *stateGetBodyRates_f(void) { return &rates; }
static struct Int32Vect3 *stateGetAccelBody_i(void) { return &acceleration; }
static struct FloatRMat *stateGetNedToBodyRMat_f(void) { return &rotation; }
static void float_rmat_vmult(struct FloatVect3 *out, const struct FloatRMat *m,
                             const struct FloatVect3 *in) {
  (void)m;
  (void)in;
  *out = velocity_of_body;
}

#include "quadjax_module.c"

/* A number, also NaN, as an integer within a range. */
static int32_t limited(float value, float low, float high) {
  return (int32_t)((value > low) ? ((value < high) ? value : high) : low);
}

static void set_state(const qj_vehicle *v) {
  position = (struct NedCoor_f){v->position[0], v->position[1], v->position[2]};
  velocity = (struct NedCoor_f){v->velocity[0], v->velocity[1], v->velocity[2]};
  quaternion = (struct FloatQuat){v->quaternion[0], v->quaternion[1], v->quaternion[2],
                                  v->quaternion[3]};
  rates = (struct FloatRates){v->rates[0], v->rates[1], v->rates[2]};
  velocity_of_body =
      (struct FloatVect3){v->body_velocity[0], v->body_velocity[1], v->body_velocity[2]};
  int32_t felt[3];
  for (uint32_t i = 0U; i < 3U; ++i) {
    felt[i] = limited(v->specific_force[i] * FIXED_ONE, -1e9F, 1e9F);
  }
  acceleration = (struct Int32Vect3){felt[0], felt[1], felt[2]};
  for (uint32_t i = 0U; i < 4U; ++i) {
    const float rpm = v->rotor_speed[i] * QJ_RPM_PER_RAD_S;
    actuators_bebop.rpm_obs[motor[i]] = (uint16_t)limited(rpm + 0.5F, 0.0F, 65535.0F);
    actuators_bebop.rpm_ref[motor[i]] = (uint16_t)limited(v->autopilot_command[i], 0.0F, 65535.0F);
  }
  gps.last_msg_time = v->position_us / 1000000U;
  gps.last_msg_ticks = v->position_us % 1000000U;
}

const char *firmware_start(void) {
  quadjax_module_init();
  return quadjax_module_wrong();
}

uint32_t firmware_call(uint32_t now_us, const qj_vehicle *vehicle, uint32_t flies,
                       float command[QJ_COMMANDS]) {
  struct preflight_result_t result = {0U};
  clock_us = now_us;
  mode = (flies != 0U) ? QUADJAX_MODE : 0U;
  if (vehicle != 0) {
    set_state(vehicle);
  }
  quadjax_module_periodic();
  for (uint32_t i = 0U; i < 4U; ++i) {
    command[i] = 0.0F;
  }
#if QUADJAX_COMMANDS_RATES
  if (quadjax_module_inner_loop(true)) {
    command[0] = inner_loop_rates.p;
    command[1] = inner_loop_rates.q;
    command[2] = inner_loop_rates.r;
    command[3] = (float)stabilization_cmd[COMMAND_THRUST];
  }
#else
  uint16_t by_motor[4];
  if (quadjax_module_rpm(by_motor)) {
    for (uint32_t i = 0U; i < 4U; ++i) {
      command[i] = (float)by_motor[motor[i]];
    }
  }
#endif
  telemetry(0, 0);
  preflight_check(&result);
  return (motors_on && (result.fails == 0U)) ? 1U : 0U;
}

qj_pilot *firmware_pilot(void) { return &pilot; }
