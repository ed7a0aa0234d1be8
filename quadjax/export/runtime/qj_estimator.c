/*
 * The estimators of external moment and force and of the highest rotor speed: see qj.h.
 *
 * Moment and force are those of quadjax/vehicle/estimator.py: with H the low-pass,
 *
 *   M_ext = H [ (I w)' + w x I w - M(rpm, v, w) ],  F_ext = H [ accelerometer - F(rpm, v) ],
 *
 * where the moment of rotor acceleration is differentiated by the filter too. The highest speed is
 * that of quadjax/vehicle/battery.py.
 */
#include "qj.h"

/* ---- the model ------------------------------------------------------------------------------- */

/* The output of a network with ReLU, of inputs in ``from``; both buffers are overwritten. */
static const float *run_network(const qj_float_layer *layer, uint32_t layers, float *from,
                                float *to) {
  for (uint32_t number = 0U; number < layers; ++number) {
    const float *weight = layer[number].weights;
    for (uint32_t row = 0U; row < layer[number].rows; ++row) {
      float sum = layer[number].bias[row];
      for (uint32_t column = 0U; column < layer[number].columns; ++column) {
        sum += weight[column] * from[column];
      }
      weight += layer[number].columns;
      to[row] = ((number + 1U < layers) && (sum < 0.0F)) ? 0.0F : sum;
    }
    float *const swapped = from;
    from = to;
    to = swapped;
  }
  return from;
}

static void residual_inputs(const qj_residual *r, const qj_measured *m, float x[10]) {
  for (uint32_t i = 0U; i < 4U; ++i) {
    x[i] = 2.0F * (m->rotor_rpm[i] - r->low_rpm) / (r->high_rpm - r->low_rpm) - 1.0F;
  }
  for (uint32_t i = 0U; i < 3U; ++i) {
    x[4U + i] = m->body_velocity[i];
    x[7U + i] = m->rates[i];
  }
}

/* Specific force (3 to 5) and moment (0 to 2) of the model, but for the rotors' acceleration. */
static void model_of(const qj_disturbance_model *model, const qj_measured *m, float out[6]) {
  const float *const w = m->rotor_rpm;
  const float *const v = m->body_velocity;
  const float s[4] = {w[0] * w[0], w[1] * w[1], w[2] * w[2], w[3] * w[3]};
  const float sum = w[0] + w[1] + w[2] + w[3];
  out[0] = model->k_p * (s[0] - s[1] - s[2] + s[3]) + model->k_pv * v[1];
  out[1] = model->k_q * (s[0] + s[1] - s[2] - s[3]) + model->k_qv * v[0];
  out[2] = model->k_r1 * (-w[0] + w[1] - w[2] + w[3]) - model->k_rr * m->rates[2];
  out[3] = -model->k_x * v[0] * sum;
  out[4] = -model->k_y * v[1] * sum;
  out[5] = -model->k_w * (s[0] + s[1] + s[2] + s[3]) - model->k_z * v[2] * sum -
           model->k_h * (v[0] * v[0] + v[1] * v[1]);
  if (model->residual != 0) {
    float buffer[2][QJ_MAX_WIDTH];
    const qj_residual *const r = model->residual;
    residual_inputs(r, m, buffer[0]);
    out[5] += run_network(r->thrust, r->thrust_layers, buffer[0], buffer[1])[0];
    residual_inputs(r, m, buffer[0]);
    const float *const moment = run_network(r->moment, r->moment_layers, buffer[0], buffer[1]);
    for (uint32_t i = 0U; i < 3U; ++i) {
      out[i] += moment[i];
    }
  }
}

/* For each channel what is low-passed, x, and what is differentiated, d. */
static void unexplained(const qj_disturbance_model *model, const qj_measured *m, float x[6],
                        float d[6]) {
  const float *const w = m->rotor_rpm;
  const float *const n = m->rates;
  const float *const inertia = model->inertia;
  float explained[6];
  model_of(model, m, explained);
  x[0] = (inertia[2] - inertia[1]) * n[1] * n[2] - explained[0];
  x[1] = (inertia[0] - inertia[2]) * n[2] * n[0] - explained[1];
  x[2] = (inertia[1] - inertia[0]) * n[0] * n[1] - explained[2];
  for (uint32_t i = 0U; i < 3U; ++i) {
    d[i] = inertia[i] * n[i];
    x[3U + i] = m->specific_force[i] - explained[3U + i];
    d[3U + i] = 0.0F;
  }
  d[2] -= model->k_r2 * (-w[0] + w[1] - w[2] + w[3]);
}

/* ---- moment and force ------------------------------------------------------------------------ */

/* The filter's memory after a sample, in the transposed direct form II. */
static void remember(const qj_disturbance_model *model, qj_disturbance *memory, uint32_t i, float x,
                     float d, float y) {
  memory->first[i] = memory->second[i] + model->low_pass[1] * x + model->derivative[1] * d -
                     model->feedback[0] * y;
  memory->second[i] = model->low_pass[2] * x + model->derivative[2] * d - model->feedback[1] * y;
}

void qj_disturbance_start(const qj_disturbance_model *model, qj_disturbance *memory,
                          const qj_measured *measured, const float estimate[6]) {
  float x[6];
  float d[6];
  unexplained(model, measured, x, d);
  for (uint32_t i = 0U; i < 6U; ++i) { /* as if d had been constant and x the estimate for long */
    memory->second[i] = 0.0F;
    remember(model, memory, i, estimate[i], d[i], estimate[i]);
    remember(model, memory, i, estimate[i], d[i], estimate[i]);
  }
}

void qj_disturbance_update(const qj_disturbance_model *model, qj_disturbance *memory,
                           const qj_measured *measured, float estimate[6]) {
  float x[6];
  float d[6];
  unexplained(model, measured, x, d);
  for (uint32_t i = 0U; i < 6U; ++i) {
    const float y = model->low_pass[0] * x[i] + model->derivative[0] * d[i] + memory->first[i];
    remember(model, memory, i, x[i], d[i], y);
    estimate[i] = y;
  }
}

/* ---- the highest rotor speed ----------------------------------------------------------------- */

void qj_battery_start(qj_battery *memory, const float rotor_rpm[4]) {
  for (uint32_t i = 0U; i < 4U; ++i) {
    memory->speed[i] = rotor_rpm[i];
    memory->expected[i] = rotor_rpm[i];
    memory->limited[i] = 0.0F;
  }
}

void qj_battery_update(const qj_battery_model *model, qj_battery *memory, const float rotor_rpm[4],
                       const float command[4], float *highest_rpm) {
  const float limit = *highest_rpm;
  float sum = 0.0F;
  for (uint32_t i = 0U; i < 4U; ++i) {
    const uint32_t is_limited = (command[i] >= limit) ? 1U : 0U;
    const float reachable = (is_limited != 0U) ? limit : command[i];
    const float apart = rotor_rpm[i] - memory->speed[i];
    memory->expected[i] += (reachable - memory->expected[i]) * model->low_pass;
    memory->limited[i] += ((float)is_limited - memory->limited[i]) * model->low_pass;
    sum += (memory->speed[i] + apart * model->lead - memory->expected[i]) * memory->limited[i];
    memory->speed[i] += apart * model->low_pass;
  }
  const float highest = limit + model->gain * sum;
  *highest_rpm = (highest > model->highest) ? model->highest
                 : (highest < model->lowest) ? model->lowest : highest;
}
