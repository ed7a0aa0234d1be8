/* An autopilot that hovers, and one run of the module in it. Prints what happened. */
#include <stdarg.h>
#include <stdio.h>

#include "autopilot.h"
#include "boards/bebop/actuators.h"
#include "modules/checks/preflight_checks.h"
#include "modules/datalink/telemetry.h"
#include "modules/made/made_module.h"
#include "state.h"

struct ActuatorsBebop actuators_bebop = {{0, 0, 0, 0}, {7500, 7500, 7500, 7500}};
struct periodic_telemetry *DefaultPeriodic;
static uint8_t mode;
static bool motors = true;
static preflight_check_f check;
static telemetry_cb telemetry;
static int sent;
static double steps; /* of the policy */

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
  sent = count;
  steps = (double)values[6];
}
struct NedCoor_f *stateGetPositionNed_f(void) {
  static struct NedCoor_f p = {-2.0f, -1.5f, -1.5f};
  return &p;
}
struct NedCoor_f *stateGetSpeedNed_f(void) {
  static struct NedCoor_f v;
  return &v;
}
struct FloatEulers *stateGetNedToBodyEulers_f(void) {
  static struct FloatEulers e;
  return &e;
}
struct FloatQuat *stateGetNedToBodyQuat_f(void) {
  static struct FloatQuat q = {1.0f, 0.0f, 0.0f, 0.0f};
  return &q;
}
struct FloatRates *stateGetBodyRates_f(void) {
  static struct FloatRates r;
  return &r;
}
struct Int32Vect3 *stateGetAccelBody_i(void) {
  static struct Int32Vect3 a = {0, 0, -10045};
  return &a;
}
struct FloatRMat *stateGetNedToBodyRMat_f(void) {
  static struct FloatRMat m = {{1, 0, 0, 0, 1, 0, 0, 0, 1}};
  return &m;
}
void float_rmat_vmult(struct FloatVect3 *out, struct FloatRMat *m, const struct FloatVect3 *in) {
  (void)m;
  *out = *in;
}

int main(void) {
  COMMAND command[4] = {0, 0, 0, 0};
  struct preflight_result_t result = {0};
  made_module_init();
  check(&result);
  made_module_periodic();
  const bool before = made_module_command(command);
  mode = AP_MODE_MODULE;
  for (int i = 0; i < 20; ++i) {
    made_module_periodic();
  }
  const bool flies = made_module_command(command);
  telemetry(0, 0);
  printf("%u %d %d %d %d %d %g %g\n", (unsigned)made_module_mismatches(), result.fails, before, flies,
         motors, sent, (double)command[0], steps);
  return 0;
}
