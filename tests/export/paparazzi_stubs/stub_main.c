/* The stand-ins' state, and what the tests call. */
#include "autopilot.h"
#include "boards/bebop/actuators.h"
#include "mcu_periph/sys_time.h"
#include "modules/checks/preflight_checks.h"
#include "modules/datalink/telemetry.h"
#include "modules/quadjax/quadjax_module.h"
#include "modules/quadjax/quadjax_policy.h"
#include "state.h"

struct ActuatorsBebop actuators_bebop;
struct periodic_telemetry *DefaultPeriodic;
static struct NedCoor_f position, velocity;
static struct FloatEulers euler;
static struct FloatQuat quaternion;
static struct FloatRates rates;
static struct Int32Vect3 acceleration;
static struct FloatVect3 body_velocity;
static uint8_t mode;
static bool motors = true;
static uint32_t now_us;
static preflight_check_f check;
static telemetry_cb telemetry;
static float sent[32];

uint8_t autopilot_get_mode(void) { return mode; }
bool autopilot_set_motors_on(bool on) { return motors = on; }
void preflight_check_register(struct preflight_check_t *c, preflight_check_f f) {
  (void)c;
  check = f;
}
void preflight_error(struct preflight_result_t *result, const char *format, ...) {
  (void)format;
  ++result->fails;
}
void preflight_success(struct preflight_result_t *result, const char *format, ...) {
  (void)result;
  (void)format;
}
int8_t register_periodic_telemetry(struct periodic_telemetry *pt, uint8_t id, telemetry_cb cb) {
  (void)pt;
  (void)id;
  telemetry = cb;
  return 0;
}
void pprz_msg_send_PAYLOAD_FLOAT(struct transport_tx *trans, struct link_device *dev, uint8_t id,
                                 uint8_t count, float *values) {
  (void)trans;
  (void)dev;
  (void)id;
  for (int i = 0; i < count; ++i) {
    sent[i] = values[i];
  }
}
uint32_t get_sys_time_usec(void) { return now_us; }
struct NedCoor_f *stateGetPositionNed_f(void) { return &position; }
struct NedCoor_f *stateGetSpeedNed_f(void) { return &velocity; }
struct FloatEulers *stateGetNedToBodyEulers_f(void) { return &euler; }
struct FloatQuat *stateGetNedToBodyQuat_f(void) { return &quaternion; }
struct FloatRates *stateGetBodyRates_f(void) { return &rates; }
struct Int32Vect3 *stateGetAccelBody_i(void) { return &acceleration; }
struct FloatRMat *stateGetNedToBodyRMat_f(void) {
  static struct FloatRMat m;
  return &m;
}
void float_rmat_vmult(struct FloatVect3 *out, struct FloatRMat *m, const struct FloatVect3 *in) {
  (void)m;
  (void)in;
  *out = body_velocity;
}

static int32_t fixed(float value) {
  return (value > -1e6F && value < 1e6F) ? (int32_t)(value * 1024.0F) : 0;
}

int stub_start(void);
int stub_step(const float *in, int flying, uint32_t calls, float *out);
const float *stub_sent(void);

/* Bit 0: the module is wrong; bit 1: the preflight check fails. */
int stub_start(void) {
  struct preflight_result_t result = {0};
  quadjax_module_init();
  check(&result);
  return ((quadjax_module_wrong() != 0) ? 1 : 0) | (result.fails << 1);
}

/* Calls of the module with position, velocity, Euler angles, quaternion, rates, rpm, specific force and
 * body velocity. Bit 0: it flies; bit 1: the motors are on. */
int stub_step(const float *in, int flying, uint32_t calls, float *out) {
  float command[4] = {0.0F, 0.0F, 0.0F, 0.0F};
  position = (struct NedCoor_f){in[0], in[1], in[2]};
  velocity = (struct NedCoor_f){in[3], in[4], in[5]};
  euler = (struct FloatEulers){in[6], in[7], in[8]};
  quaternion = (struct FloatQuat){in[9], in[10], in[11], in[12]};
  rates = (struct FloatRates){in[13], in[14], in[15]};
  acceleration = (struct Int32Vect3){fixed(in[20]), fixed(in[21]), fixed(in[22])};
  body_velocity = (struct FloatVect3){in[23], in[24], in[25]};
  for (int i = 0; i < 4; ++i) {
    actuators_bebop.rpm_obs[i] = (uint16_t)((in[16 + i] > 0.0F && in[16 + i] < 65535.0F) ? in[16 + i] : 0.0F);
  }
  mode = flying ? AP_MODE_MODULE : 0;
  for (uint32_t i = 0U; i < calls; ++i) {
    now_us += 1000000U / QUADJAX_FREQUENCY;
    quadjax_module_periodic();
  }
  const bool flies = quadjax_module_command(command);
  for (int i = 0; i < 4; ++i) {
    out[i] = command[i];
  }
  return (flies ? 1 : 0) | (motors ? 2 : 0);
}

const float *stub_sent(void) {
  telemetry(0, 0);
  return sent;
}
