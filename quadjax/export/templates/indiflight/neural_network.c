/*
 * ${name} for INDIflight: see neural_network.h. The text below is the exported ${name}.c.
 */
#include "neural_network.h"

${source}
/* ---- INDIflight --------------------------------------------------------------------------------- */

void nn_forward(const float *input, float *output) { (void)${name}_forward(input, output); }
