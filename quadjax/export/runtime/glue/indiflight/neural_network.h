/* A quadjax policy for INDIflight, src/main/flight/neural_controllers/: the network alone. */
#pragma once

/* Motor commands of an observation, which is scaled as in the policy's header: each within 0 .. 1
 * and never NaN, whatever comes in. Motors in the order of the policy: front-left,
 * front-right, rear-right, rear-left. 0 before nn_reset, or if the policy is refused. */
void nn_forward(const float *input, float *output);
