/*
 * ${name} for INDIflight, src/main/flight/neural_controllers/: the network in fixed point.
 *
 * The text below is the exported ${name}.h; nn_forward is what the firmware calls.
 */
#pragma once

${header}
/* The observation, as floats in the units of the list above, to the motor commands: each within
 * 0 .. 1 and never NaN, whatever comes in. Motors in the order of the policy: front-left,
 * front-right, rear-right, rear-left. */
void nn_forward(const float *input, float *output);
