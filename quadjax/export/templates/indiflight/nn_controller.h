/*
 * ${name} for INDIflight, src/main/flight/neural_controllers/: observation, gates and commands.
 *
${origin.lines | comment}
 *
 * World north-east-down, body forward-right-down, SI units. Rotors and motors in INDIflight's order:
 * rear-right, front-right, rear-left, front-left.
 */
#pragma once

#include <stdint.h>

#define GATES_AHEAD 1
#define NUM_GATES ${race.gates}

{% if race.box.layout.counts_steps %}
/* The policy observes earlier steps, of ${race.time_step | number} s. NN_CONTROL_HZ is the rate at which the firmware
 * calls nn_control (inner loops per second by rate_denom): change it if yours differs. The policy
 * runs at every NN_STEP_CALLS-th call; its commands are held in between. */
#ifndef NN_CONTROL_HZ
#define NN_CONTROL_HZ ${call_rate}
#endif
#define NN_PERIOD_NS ${period_ns}LL /* of a step of the policy */
#define NN_STEP_CALLS ((NN_CONTROL_HZ * NN_PERIOD_NS + 500000000LL) / 1000000000LL)
#if (20 * NN_CONTROL_HZ * NN_PERIOD_NS > 21000000000LL * NN_STEP_CALLS) || \
    (20 * NN_CONTROL_HZ * NN_PERIOD_NS < 19000000000LL * NN_STEP_CALLS) || (NN_STEP_CALLS < 1)
#error "NN_CONTROL_HZ: no whole number of calls is a step of the policy, within 5%"
#endif
{% else %}
/* Call nn_control at any rate; the policy was trained with steps of ${race.time_step | number} s. It runs at every call. */
#define NN_STEP_CALLS 1
{% endif %}

extern const float gate_pos[NUM_GATES][3]; /* centers, m */
extern const float gate_yaw[NUM_GATES];    /* direction of flight, rad */
extern const float start_pos[3];           /* m */
extern const float start_yaw;              /* rad */
extern uint8_t target_gate_index;          /* gate to pass next; written here only */

/* What was wrong with the inputs since start-up. */
typedef struct {
  uint32_t steps;         /* of the policy */
  uint32_t nan_steps;     /* in which a number was NaN; it is taken as zero */
  uint32_t clipped_steps; /* in which a number was outside its range; it is taken as the edge */
  uint32_t outside_steps; /* in which an input of the network was outside its range */
  uint32_t gates_passed;  /* since nn_reset */
  uint32_t gates_missed;  /* since nn_reset: planes crossed beside the opening */
} nn_counters_t;

/* The self-tests of tables, network and observation; returns the number of mismatches. Call it at
 * start-up and refuse to arm unless it is 0. nn_reset and nn_control call it if nobody did, which
 * takes as long as about ${selftest_inferences} inferences. After a mismatch all motor commands are 0. */
uint32_t nn_self_test(void);

/* On activation: the next call of nn_control starts a race towards gate 0. */
void nn_reset(void);

/* world_state: position (3), velocity (3), roll, pitch, yaw, p, q, r, rotor speeds (4) in rad/s.
 * motor_cmds: each within 0 .. 1 and never NaN, whatever comes in. */
void nn_control(const float world_state[16], float motor_cmds[4]);

nn_counters_t nn_counters(void);
