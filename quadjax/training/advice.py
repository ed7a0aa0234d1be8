"""Advice for a training run that completes no lap."""

from collections import Counter
from collections.abc import Iterable

GUIDE = "docs/guide/track.md, When it does not learn"
CHANGES = {  # by the reason of CRASHES
    "hit a gate": "raise reward.gate_edge or run.steps; for gates too close to each other to be "
    "passed, lower training_limits.gate_inflation",
    "hit the ground": "lower start.position and start.roll_pitch_deg, or raise the gates",
    "out of bounds": "raise rules.position_limit",
    "lost its attitude": "raise training_limits.pitch_deg, or lower vehicle.residual_gain",
    "not finite": "check the constants of the vehicle: quadjax vehicle FILE",
    "ended by an extra rule": "check rules.extra",
    "out of time": "raise training_limits.gate_inflation and learner.discount, or run.steps",
}


def no_lap(crashes: Iterable[str]) -> str:
    """Why the flights of a policy that completes no race ended, and what to change: two lines.

    Args:
        crashes: why each flight ended: a reason of ``quadjax.race.result.CRASHES``, or "".

    Returns:
        The lines, or nothing if every flight completed its laps.
    """
    counts = Counter(reason for reason in crashes if reason)
    if not counts:
        return ""
    total = sum(counts.values())
    shares = ", ".join(f"{reason} ({n} of {total})" for reason, n in counts.most_common())
    most = counts.most_common(1)[0][0]
    return f"no flight completes its laps yet: {shares}\n{CHANGES[most]}; see {GUIDE}"
