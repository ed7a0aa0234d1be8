/* What benchmarks/instructions.py counts on an emulated processor, and what a compiler may call there:
 * functions of the C library by the names of the ARM ABI. */
#include <stddef.h>

#include "qj_pilot.h"

void *memset(void *to, int value, size_t size);
void *memcpy(void *restrict to, const void *restrict from, size_t size);
uint32_t bench_kernel(qj_pilot *pilot, uint32_t neon);
void bench_infer(const qj_pilot *pilot, const float *x, float *out);
void bench_step(qj_pilot *pilot, const qj_vehicle *vehicle, float *out);

/* Use a kernel; returns its mismatches in the self-tests. */
uint32_t bench_kernel(qj_pilot *pilot, uint32_t neon) {
  pilot->policy.kernel = (neon != 0U) ? QJ_NEON : QJ_SCALAR;
  return qj_self_test(&pilot->policy);
}

/* One inference from a given observation. */
void bench_infer(const qj_pilot *pilot, const float *x, float *out) {
  int32_t q[QJ_MAX_WIDTH];
  int32_t command[QJ_COMMANDS];
  (void)qj_quantize(&pilot->policy, x, q);
  qj_forward(&pilot->policy, q, command, 0);
  qj_commands(&pilot->policy, command, out);
}

/* A step on board. */
void bench_step(qj_pilot *pilot, const qj_vehicle *vehicle, float *out) {
  pilot->racing = 0U; /* so that every call is a step */
  (void)qj_pilot_step(pilot, vehicle->time_us, vehicle, out);
}

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
