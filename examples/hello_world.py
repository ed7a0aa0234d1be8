"""Train a policy, time its laps, draw the fastest run."""

import quadjax

config = quadjax.load("e2e")
run = quadjax.train(config)
laps = quadjax.evaluate(run.policy, config, runs=100)
print(laps.table())
laps.plot().savefig(run.folder / "lap.png")
