/* A quadjax policy for INDIflight, src/main/flight/neural_controllers/: the network alone. */
#pragma once

/* The observation, as floats in the units of the policy's table, to the motor commands: each within
 * 0 .. 1 and never NaN, whatever comes in. Motors in the order of the policy: front-left,
 * front-right, rear-right, rear-left. 0 before nn_reset, or if the policy is refused. */
void nn_forward(const float *input, float *output);
