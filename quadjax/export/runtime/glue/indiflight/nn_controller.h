/*
 * A quadjax policy for INDIflight, src/main/flight/neural_controllers/: observation, gates,
 * commands.
 *
 * World north-east-down, body forward-right-down, SI units. Rotors and motors in INDIflight's
 * order: rear-right, front-right, rear-left, front-left.
 */
#pragma once

#include <stdint.h>

#include "quadjax_policy.h" /* NUM_GATES, gates and start */

#define GATES_AHEAD 1

/* The rate at which the firmware calls nn_control (inner loops per second by rate_denom): change it
 * if yours differs. A policy that observes its last action runs at the rate of its training, and
 * its commands are held in between; any other one runs at every call. */
#ifndef NN_CONTROL_HZ
#define NN_CONTROL_HZ 500
#endif

extern const float gate_pos[NUM_GATES][3]; /* centers, m */
extern const float gate_yaw[NUM_GATES];    /* direction of flight, rad */
extern const float start_pos[3];           /* m */
extern const float start_yaw;              /* rad */
extern uint8_t target_gate_index;          /* gate to pass next; written here only */

/* What was wrong with the inputs since start-up. */
typedef struct {
  uint32_t steps;         /* of the policy */
  uint32_t nan_calls;     /* with a number that was not finite: no state */
  uint32_t outside_steps; /* in which an input of the network was outside its range: its edge */
  uint32_t gates_passed;  /* since nn_reset */
  uint32_t gates_missed;  /* since nn_reset: planes crossed beside the opening */
} nn_counters_t;

/* Tests the policy; returns 0, or what is wrong. Call it at start-up and refuse to arm unless it is
 * 0. nn_reset and nn_control call it if nobody did, which takes as long as about 20 inferences. If
 * something is wrong all motor commands are 0. */
const char *nn_load(void);

/* On activation: the next call of nn_control starts a race towards gate 0. */
void nn_reset(void);

/* world_state: position (3), velocity (3), roll, pitch, yaw, p, q, r, rotor speeds (4) in rad/s.
 * motor_cmds: each within 0 .. 1 and never NaN, whatever comes in. */
void nn_control(const float world_state[16], float motor_cmds[4]);

nn_counters_t nn_counters(void);
