/* Attitudes: yaw, then pitch, then roll. The only file of the runtime that needs the C library. */
#include <math.h>

#include "qj_pilot.h"

void qj_euler_of(const float quaternion[4], float euler[3]) {
  const float w = quaternion[0];
  const float x = quaternion[1];
  const float y = quaternion[2];
  const float z = quaternion[3];
  const float sine = 2.0F * (w * y - z * x);
  euler[0] = atan2f(2.0F * (w * x + y * z), 1.0F - 2.0F * (x * x + y * y));
  euler[1] = asinf((sine > 1.0F) ? 1.0F : ((sine < -1.0F) ? -1.0F : sine));
  euler[2] = atan2f(2.0F * (w * z + x * y), 1.0F - 2.0F * (y * y + z * z));
}

void qj_quaternion_of(const float euler[3], float quaternion[4]) {
  const float cr = cosf(0.5F * euler[0]);
  const float sr = sinf(0.5F * euler[0]);
  const float cp = cosf(0.5F * euler[1]);
  const float sp = sinf(0.5F * euler[1]);
  const float cy = cosf(0.5F * euler[2]);
  const float sy = sinf(0.5F * euler[2]);
  quaternion[0] = cr * cp * cy + sr * sp * sy;
  quaternion[1] = sr * cp * cy - cr * sp * sy;
  quaternion[2] = cr * sp * cy + sr * cp * sy;
  quaternion[3] = cr * cp * sy - sr * sp * cy;
}
