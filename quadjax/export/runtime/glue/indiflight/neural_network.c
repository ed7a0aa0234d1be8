/* The runtime of the policy: INDIflight compiles neural_network.c and nn_controller.c only. */
#include "qj_estimator.c"
#include "qj_network.c"
#include "qj_observation.c"
#include "qj_pilot.c"
#include "qj_race.c"
