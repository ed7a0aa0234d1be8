"""Train on a random track, which a seed and a few settings determine."""

import quadjax

track = ["track.generate.seed=3", "track.generate.gates=6", "track.generate.turn_deg=100"]
config = quadjax.load("e2e", ["+gate_edge", *track, "name=random_track"])
for gate in config.track.gates:
    print(gate.position, gate.yaw_deg)
run = quadjax.train(config)
laps = quadjax.evaluate(run.policy, config, runs=100)
print(laps.table())
