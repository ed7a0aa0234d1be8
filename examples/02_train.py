"""Train a policy while some numbers change on a schedule, time its laps, draw the fastest run."""

import quadjax

SCHEDULES = [  # any number of the learner, the reward or the race can have one
    "schedules.learner.std={linear: [0.3, 0.05]}",  # less noise, over the whole run
    "schedules.reward.gate_offset={linear: [10, 5], from: 0.25, until: 0.75}",  # fractions
    "schedules.start.yaw_deg={linear: [20, 180], until: 0.5}",
]


def main():
    config = quadjax.load("e2e", ["name=scheduled", *SCHEDULES])
    run = quadjax.train(config, overwrite=True)
    print("noise at first and at the end:", run.metrics["std"][[0, -1]])
    laps = quadjax.evaluate(run.policy, config, runs=100)
    print(laps.table())
    laps.plot().savefig(run.folder / "lap.png")


if __name__ == "__main__":
    main()
