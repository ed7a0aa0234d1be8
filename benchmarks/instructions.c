/* What benchmarks/instructions.py runs and counts on an emulated processor, and what a compiler may
 * call there: functions of the C library by the names of the ARM ABI. */
#include <stddef.h>

#include "qj_pilot.h"
#include "quadjax_policy.h"

static const qj_policy *const policy = &QUADJAX_POLICY;
static qj_kernel kernel;
static qj_pilot pilot;

void *memset(void *to, int value, size_t size);
void *memcpy(void *restrict to, const void *restrict from, size_t size);
uint32_t bench_start(uint32_t neon, uint32_t calls_per_s);
void bench_forward(const int32_t *q, int32_t *out, uint32_t count);
void bench_infer(const float *x, float *out);
void bench_step(const qj_vehicle *vehicle, float *out);

/* Use a kernel; returns whether the pilot takes the policy. */
uint32_t bench_start(uint32_t neon, uint32_t calls_per_s) {
  kernel = (neon != 0U) ? QJ_NEON : QJ_SCALAR;
  return (qj_pilot_start(&pilot, policy, kernel, (float)calls_per_s) == 0) ? 1U : 0U;
}

/* Rows: commands, trace. */
void bench_forward(const int32_t *q, int32_t *out, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i, out += QJ_COMMANDS + 1) {
    uint32_t trace;
    qj_forward(policy, kernel, q + i * policy->inputs, out, &trace);
    out[QJ_COMMANDS] = (int32_t)trace;
  }
}

/* One inference from a given observation. */
void bench_infer(const float *x, float *out) {
  int32_t q[QJ_MAX_WIDTH];
  (void)qj_quantize(policy, x, q);
  qj_act(policy, kernel, q, 0, out);
}

/* A step on board. */
void bench_step(const qj_vehicle *vehicle, float *out) {
  qj_pilot_reset(&pilot); /* so that every call is a step */
  (void)qj_pilot_call(&pilot, vehicle->time_us, vehicle, out);
}

#ifdef BENCH_MATH /* rough ones, where there is no C library: what uses them is not counted */
float atan2f(float y, float x);
float asinf(float x);
float atan2f(float y, float x) {
  const float up = (y < 0.0F) ? -y : y;
  const float aside = (x < 0.0F) ? (x + up) / (up - x + 1e-20F) : (x - up) / (x + up + 1e-20F);
  const float middle = (x < 0.0F) ? 2.3561945F : 0.7853982F;
  const float angle = middle - 0.9817F * aside + 0.1963F * aside * aside * aside;
  return (y < 0.0F) ? -angle : angle;
}
float asinf(float x) { return atan2f(x, 1.0F - 0.5F * x * x); }
#endif

#define OF_THE_ABI(suffix)                                                                     \
  void __aeabi_memclr##suffix(void *to, size_t size);                                          \
  void __aeabi_memset##suffix(void *to, size_t size, int value);                               \
  void __aeabi_memcpy##suffix(void *to, const void *from, size_t size);                        \
  void __aeabi_memclr##suffix(void *to, size_t size) { memset(to, 0, size); }                  \
  void __aeabi_memset##suffix(void *to, size_t size, int value) { memset(to, value, size); }   \
  void __aeabi_memcpy##suffix(void *to, const void *from, size_t size) { memcpy(to, from, size); }
OF_THE_ABI()
OF_THE_ABI(4)
OF_THE_ABI(8)

void *memset(void *to, int value, size_t size) {
  volatile unsigned char *byte = to;
  while (size-- != 0U) {
    *byte++ = (unsigned char)value;
  }
  return to;
}

void *memcpy(void *restrict to, const void *restrict from, size_t size) {
  volatile unsigned char *byte = to;
  const unsigned char *source = from;
  while (size-- != 0U) {
    *byte++ = *source++;
  }
  return to;
}
