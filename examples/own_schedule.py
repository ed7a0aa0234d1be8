"""Change numbers of the learner, the reward or the race during training."""

import quadjax

schedules = [
    "schedules.learner.std={linear: [0.3, 0.05]}",  # less noise, over the whole run
    "schedules.reward.gate_offset={linear: [10, 5], from: 0.25, until: 0.75}",  # of the run
    "schedules.start.yaw_deg={linear: [20, 180], until: 0.5}",
]
config = quadjax.load("e2e", [*schedules, "name=own_schedule"])
run = quadjax.train(config)
print(run.metrics["std"][[0, -1]])
