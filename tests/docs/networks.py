"""Networks in C of the shape of those of the paper, for the commands of ``other_trainers.md``."""

from pathlib import Path

from tests.policy.writers import c_source, linear

FILES = {  # sizes of the layers, and the beginning of the names in C
    "E2Enet/neural_network.c": ((24, 8, 4), ""),
    "c_code/neural_network.c": ((17, 8, 4), ""),
    "nn_thrust.c": ((7, 8, 1), "nn_thrust_"),
    "nn_moment.c": ((10, 8, 3), "nn_moment_"),
}
STD = "const float output_std[4] = {0.1, 0.2, 0.3, 0.4};\n"


def write() -> None:
    """The files of the two clones, in the current folder, with small random networks."""
    for name, (sizes, prefix) in FILES.items():
        file = Path(name)
        file.parent.mkdir(exist_ok=True)
        file.write_text(c_source(linear(sizes), prefix, body="relu(x);"))
        if not prefix:
            file.with_name("nn_controller.c").write_text(STD)
