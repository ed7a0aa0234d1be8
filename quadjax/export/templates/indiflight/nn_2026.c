/*
 * ${name} in the form of INDIflight's controllers of 2026, one file for each. UNTESTED: the headers
 * of that form are not public, so this file was never compiled. It has the float network, not the
 * proven one: no range or self-test holds. Prefer the four files of ${name}'s other folder.
 *
${origin.lines | comment}
 *
 * Inputs in the order of the policy; rotors and motors: front-left, front-right, rear-right,
 * rear-left. Outputs are actions of -1 .. 1, which stand for the whole range of a command. Define
 * NN_RUN_FUNC as the function that computes the observation and calls the network.
 */
#include "nn_controllers.h"

{% for kernel, bias in layers %}
static const float weights_${loop.index0}[${kernel.size}] = {
${kernel | each("float32") | wrapped}};
static const float biases_${loop.index0}[${bias.size}] = {
${bias | each("float32") | wrapped}};
static float activations_${loop.index0}[${bias.size}];
{% endfor %}
static const float std[4] = {${std | each("float32") | join(", ")}};

static nn_layer_t layers[] = {
{% for kernel, bias in layers %}
    {${kernel.shape[1]}, ${kernel.shape[0]}, weights_${loop.index0}, biases_${loop.index0}, activations_${loop.index0}, ${"NULL" if loop.last else "nn_neuron_relu"}},
{% endfor %}
};

static nn_network_t network = {
    .name = ${name | string},
    .n_in = ${network.inputs},
    .n_out = ${network.outputs},
    .n_layers = ${layers | length},
    .layers = layers,
    .stddev_gaussian = std,
};

static nn_controller_t controller = {
    .network = &network,
    .gates_ahead = 1,
    .run_func = NN_RUN_FUNC,
};

/* x, y, z, psi, gate_psi, v_sp, type */
static waypoint_t waypoints[${race.gates + 1}] = {
    {${start_position | each("float32") | join(", ")}, ${start_yaw | float32}, ${start_yaw | float32}, 0.0F, WAYPOINT_START},
{% for g in range(race.gates) %}
    {${gate_positions[g] | each("float32") | join(", ")}, ${gate_yaws[g] | float32}, ${gate_yaws[g] | float32}, 0.0F, WAYPOINT_GATE},
{% endfor %}
};

static flightplan_t flightplan = {
    .n_waypoints = ${race.gates + 1},
    .waypoints = waypoints,
};

void nn_use_${name}(void);
void nn_use_${name}(void) {
  nn_set_controller(&controller);
  nn_set_flightplan(&flightplan);
}
