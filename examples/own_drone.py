"""Train your own drone: a YAML file with its constants (own_drone.yaml)."""

from pathlib import Path

import quadjax

drone = Path(__file__).with_name("own_drone.yaml")
config = quadjax.load("e2e", [f"vehicle={drone}", "name=own_drone"])
run = quadjax.train(config)
print(quadjax.evaluate(run.policy, config, deterministic=True).table())
