"""Advice for a training run that completes no lap."""

import textwrap
from collections import Counter
from collections.abc import Iterable

FEW_STEPS = 4e6  # before which hardly any run completes a lap
GUIDE = "docs/guide/track.md, When it does not learn"
CHANGES = {  # by the name of the termination
    "hit a gate": "raise reward.gate_edge or run.steps; for gates too close to each other to be "
    "passed, lower training_limits.gate_inflation",
    "hit the ground": "lower start.position and start.roll_pitch_deg, or raise the gates",
    "out of bounds": "raise rules.position_limit",
    "above the body rate limit": "raise rules.body_rate_limit or reward.body_rates",
    "above the training limit of the yaw rate": "raise training_limits.yaw_rate",
    "lost its attitude": "raise training_limits.pitch_deg, or lower vehicle.residual_gain",
    "not finite": "check the constants of the vehicle: quadjax show FILE",
    "above the speed limit": "raise reward.overspeed or reward.overspeed_margin",
    "out of time": "raise training_limits.gate_inflation and learner.discount, or run.steps",
}
OWN_RULE = "check rules.extra"


def no_lap(crashes: Iterable[str], steps: float) -> str:
    """Why the flights of a policy that completes no race ended, and what to change.

    Args:
        crashes: why each flight ended: a name of ``quadjax.race.rules.TERMINATIONS``, or "".
        steps: environment steps of the training.

    Returns:
        Lines of at most 79 characters, or nothing if every flight completed its laps.
    """
    counts = Counter(reason for reason in crashes if reason)
    if not counts:
        return ""
    total = sum(counts.values())
    shares = ", ".join(f"{reason} ({n} of {total})" for reason, n in counts.most_common())
    advice = f"{CHANGES.get(counts.most_common(1)[0][0], OWN_RULE)}; see {GUIDE}"
    if steps < FEW_STEPS:
        advice = f"{steps:,.0f} steps are few: the first laps take some millions (run.steps)"
    lines = (f"no flight completes its laps yet: {shares}", advice)
    return "\n".join(textwrap.fill(line, 79, break_on_hyphens=False) for line in lines)
