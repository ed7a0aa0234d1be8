"""Train on your own track: a YAML file with gates (own_track.yaml)."""

from pathlib import Path

import quadjax

track = Path(__file__).with_name("own_track.yaml")
config = quadjax.load("e2e", ["+gate_edge", f"track={track}", "name=own_track"])
run = quadjax.train(config)
laps = quadjax.evaluate(run.policy, config, runs=100, start="random")
print(laps.table())
