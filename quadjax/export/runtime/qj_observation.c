/* The observation: see qj.h. */
#include <math.h>

#include "qj.h"

#define TWO_PI 6.2831853071795865F

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

/* A world vector in the gate's frame. */
static void to_gate(const qj_gate *gate, float x, float y, float z, float *out) {
  out[0] = gate->cos_yaw * x + gate->sin_yaw * y;
  out[1] = gate->cos_yaw * y - gate->sin_yaw * x;
  out[2] = z;
}

static void attitude(const qj_gate *gate, const float quaternion[4], float *out) {
  qj_euler_of(quaternion, out);
  const float apart = out[2] - gate->yaw;
  out[2] = apart - TWO_PI * floorf(apart / TWO_PI + 0.5F);
}

/* The body's x and z axes in the gate's frame: columns of the rotation matrix. */
static void rotation(const qj_gate *gate, const float quaternion[4], float *out) {
  const float w = quaternion[0];
  const float x = quaternion[1];
  const float y = quaternion[2];
  const float z = quaternion[3];
  to_gate(gate, 1.0F - 2.0F * (y * y + z * z), 2.0F * (x * y + w * z), 2.0F * (x * z - w * y), out);
  to_gate(gate, 2.0F * (x * z + w * y), 2.0F * (y * z - w * x), 1.0F - 2.0F * (x * x + y * y),
          out + 3);
}

static const float *copy(float *out, const float *from, uint32_t count) {
  for (uint32_t i = 0U; i < count; ++i) {
    out[i] = from[i];
  }
  return from + count;
}

void qj_observe(const qj_policy *policy, const qj_state *s, uint32_t target, float *x) {
  const uint32_t number = (target < policy->gates) ? target : 0U;
  const qj_gate *const gate = policy->gate + number;
  const float *constant = policy->gate_constant + number * policy->gate_constants;
  float *out = x;
  for (uint32_t i = 0U; i < policy->parts; ++i) {
    const uint32_t size = policy->part[i].size;
    switch (policy->part[i].field) {
      case QJ_POSITION:
        to_gate(gate, s->position[0] - gate->position[0], s->position[1] - gate->position[1],
                s->position[2] - gate->position[2], out);
        break;
      case QJ_VELOCITY:
        to_gate(gate, s->velocity[0], s->velocity[1], s->velocity[2], out);
        break;
      case QJ_ATTITUDE:
        attitude(gate, s->quaternion, out);
        break;
      case QJ_ROTATION:
        rotation(gate, s->quaternion, out);
        break;
      case QJ_RATES:
        (void)copy(out, s->rates, size);
        break;
      case QJ_ROTOR_SPEED:
        (void)copy(out, s->rotor_speed, size);
        break;
      case QJ_THRUST:
        out[0] = s->thrust;
        break;
      case QJ_LAST_COMMAND:
        (void)copy(out, s->last_command, size);
        break;
      case QJ_MOMENT_EXT:
        (void)copy(out, s->moment_ext, size);
        break;
      case QJ_FORCE_EXT_Z:
        out[0] = s->force_ext[2];
        break;
      case QJ_HIGHEST_RPM:
        out[0] = s->highest_rpm;
        break;
      default: /* QJ_OF_GATE */
        constant = copy(out, constant, size);
        break;
    }
    out += size;
  }
  for (uint32_t i = 0U; i < policy->inputs; ++i) {
    x[i] = (x[i] - policy->input[i].middle) * policy->input[i].factor;
  }
}

uint32_t qj_observes(const qj_policy *policy, qj_field field) {
  uint32_t observed = 0U;
  for (uint32_t i = 0U; i < policy->parts; ++i) {
    observed |= (policy->part[i].field == field) ? 1U : 0U;
  }
  return observed;
}
