"""The section ``observation`` of a config: which fields of the race a policy observes."""

from typing import Annotated, Literal

from quadjax.core.sections import LARGEST, ORDERED, Code, Field, Needs, Section

Source = Literal["ground_truth", "estimated", "none"]  # of an observed disturbance or limit
ESTIMATED: Source = "estimated"
NONE: Source = "none"
Actuator = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]  # in the model's unit
Ends = Annotated[tuple[Actuator, Actuator], ORDERED]


class Observation(Section):
    """What the policy observes."""

    disturbance: Source = Field(
        "ground_truth",
        description="source of the observed external disturbance: the simulator, the onboard "
        "estimator, or zeros",
    )
    highest_rpm: Annotated[Source, Needs("battery")] = Field(
        "estimated",
        description="source of the observed limit of the propeller speeds, with a battery, as for "
        "disturbance; none: it is not observed",
    )
    attitude: Literal["euler", "rotation"] = Field(
        "euler",
        description="roll, pitch and the yaw relative to the gate (3), or the body's x and z axes "
        "in the gate's frame (6), which have no singularity",
    )
    gates_ahead: int = Field(
        1,
        ge=1,
        le=4,
        description="number of gates after the target whose position and yaw are observed",
    )
    last_action: bool = Field(
        False, description="observe the action of the step before, -1 to 1; 0 at the start"
    )
    actuators: bool = Field(
        True, description="observe the actuators' state; false: for drones that do not measure it"
    )
    actuator_range: Annotated[Ends | None, Needs("observation.actuators")] = Field(
        None,
        description="actuator states that are observed as -1 and 1, in the model's unit; null: "
        "their nominal range (arXiv 2504.21586: [0, 3000] rad/s)",
    )
    wrap_next_yaw: bool = Field(
        True,
        description="wrap the next gate's relative yaw to +-180 deg; the authors' code does not",
    )
    critic_constants: bool = Field(
        False,
        description="the critic, not the policy, also observes the constants that randomization "
        "draws; the policy file then has no critic",
    )
    extra: Annotated[tuple[str, ...], Code()] = Field(
        (), max_length=32, description="further fields, each the module:FIELD of your own Field"
    )


PUBLISHED = Observation()
