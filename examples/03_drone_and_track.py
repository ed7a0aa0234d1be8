"""Train another drone on another track: YAML files with its constants and with the gates."""

from pathlib import Path

import quadjax

FOLDER = Path(__file__).parent
DRONE = f"vehicle={FOLDER / '03_drone.yaml'}"
TRACKS = {
    "triangle": [f"track={FOLDER / '03_track.yaml'}"],
    "random": [  # the seed and the settings determine the gates
        "track.generate.seed=3",
        "track.generate.gates=6",
        "track.generate.turn_deg=100",
    ],
}


def main():
    for name, track in TRACKS.items():
        config = quadjax.load("e2e", ["+gate_edge", DRONE, *track, f"name={name}"])
        for gate in config.track.gates:
            print(gate.position, gate.yaw_deg)
        run = quadjax.train(config, overwrite=True)
        print(quadjax.evaluate(run.policy, config, runs=100, start="random").table())


if __name__ == "__main__":
    main()
