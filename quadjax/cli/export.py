"""``quadjax export``."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import wrote
from quadjax.core.errors import quadjax_command
from quadjax.core.interruptions import loading
from quadjax.export.names import POWER_OF_TWO, check_new_folder, is_range, symbol_name
from quadjax.export.targets import DEFAULT_TARGET, TARGETS

Target = Annotated[str, Parameter(choices=tuple(TARGETS))]
OF_RANGE = f"FIELD=R with R {POWER_OF_TWO}, such as position=16"
Ranges = Annotated[
    tuple[Annotated[str, opt.named_number(OF_RANGE, is_range)], ...],
    Parameter(name="--range", metavar="FIELD=R"),
]


def export(
    policy: Annotated[opt.PolicyFile, Parameter(name="POLICY")],
    /,
    *,
    output: opt.Folder,
    target: Target = DEFAULT_TARGET,
    name: str | None = None,
    range_: Ranges | None = None,
    track: Annotated[str | None, opt.config_parameter("tracks")] = None,
    race: opt.Race = None,
    sample_rate: Annotated[float | None, opt.number(1.0, 1e5)] = None,
    cutoff: Annotated[float | None, opt.number(0.001, 25_000.0)] = None,
    sampled: opt.Flag = False,
    allow_unfinished: opt.AllowUnfinished = False,
    allow_other_race: opt.AllowOtherRace = False,
    overwrite: opt.Flag = False,
) -> None:
    """Convert a policy file to C: the network in fixed point, the rest in float.

    DIR gets the network, the observation, the gates, the estimators and self-tests
    as constant arrays in NAME.h, the C runtime, the glue of the target, and a report of
    proofs and measurements. The command quadjax verify DIR builds and runs it.

    Example: quadjax export e2e --output out --target cortex-a9

    Args:
        policy: Policy file, or a shipped one's name.
        output: Folder for the C.
        target: Processor and autopilot.
        name: Name of the header and of the policy in it (default: the file's name).
        range_: Declare +-R for an input instead of the default, a power of two:
            position=16; may be repeated.
        race: Training config of the policy's race (default: the one in the policy file).
        sample_rate: Sample rate of the estimators, Hz (default: 512).
        cutoff: Cut-off of the disturbance estimator's low-pass, Hz (default: 8).
        sampled: The C samples the actions with the noise of the training (default: the
            mean action).
        overwrite: Replace an earlier export; write to a folder that no export made, and
            replace its files of the same names.
    """
    ranges = opt.by_name("--range", range_)
    check_new_folder(output, symbol_name(name, policy.name), overwrite)
    with loading():
        from quadjax.export.convert import export_c

    result = export_c(
        policy,
        output,
        race,
        ranges,
        name,
        track=track,
        sample_rate=sample_rate,
        cutoff=cutoff,
        sampled=sampled,
        allow_unfinished=allow_unfinished,
        allow_other_race=allow_other_race,
        target=target,
        overwrite=overwrite,
    )
    print(result.summary)
    folder = output / result.converted.target.folder
    wrote(f"{folder}/", output / f"{result.name}_report.txt")
    print(f"Next: {verification(output, allow_unfinished, allow_other_race)}")
    print(f"Then: {quadjax_command('sil', output)}")


def verification(output: Path, allow_unfinished: bool, allow_other_race: bool) -> str:
    """The command that verifies an export, with the allowances that it needs too."""
    allowances = {
        "--allow-unfinished": allow_unfinished,
        "--allow-other-race": allow_other_race,
    }
    used = [option for option, value in allowances.items() if value]
    return quadjax_command("verify", output, *used)
