"""``quadjax show``."""

import itertools
import re
import textwrap
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from quadjax.cli.files import check_writable
from quadjax.cli.options import Flag, Overrides, Picture
from quadjax.cli.output import note, wrote
from quadjax.core.errors import InputError, quadjax_command
from quadjax.core.interruptions import loading
from quadjax.core.resources import CONFIGS, KINDS, policy_names, preset_names


def show(
    what: Annotated[str | None, Parameter(name="WHAT")] = None,
    /,
    *overrides: Overrides,
    write: Literal["track", "vehicle"] | None = None,
    overwrite: Flag = False,
    figure: Picture = None,
    model: Annotated[str | None, Parameter(metavar="module:OBJECT")] = None,
) -> None:
    """List presets, parts, tracks, vehicles and policies, or print one of them.

    Without WHAT, everything that comes with the package is listed by name.
    WHAT is a name or a file; what it contains decides what is printed:

    - a config, a plant or a fit config: every key with its value and description,
      after the overrides;
    - a track: the gates, length and slope of the leg to each, the turn there;
    - a vehicle: hover command, thrust-to-weight ratio, largest body rates and
      time constants of each model in the file, and implausible values;
    - a policy (FILE.npz; a shipped one: NAME.npz): network and source.

    With --write, the file WHAT is written first: a random track from settings
    such as seed and gates, or a vehicle from data of its airframe such as mass
    and wheelbase. Without WHAT, --write lists these keys.

    Example: quadjax show mine.yaml --write track seed=3 gates=12 --figure mine.png

    Args:
        what: The name or the file.
        write: Write the file WHAT from the settings KEY=VALUE.
        overwrite: Replace existing files.
        figure: Draw the track from two sides.
        model: Your own VehicleModel (default: those in the vehicle file).
    """
    if what is None and write is None:
        print(listing())
        return
    with loading():
        from quadjax.cli import catalog
        from quadjax.core.plotting import save_figure
        from quadjax.evaluation.figures import trajectory_figure

    if what is None:
        print(catalog.keys_text(write or ""))
        return
    if figure is not None:
        check_writable(figure, overwrite=overwrite)
    if write is not None:
        check_writable(Path(what), (".yaml",), overwrite)
        (catalog.write_track if write == "track" else catalog.write_vehicle)(Path(what), overrides)
        wrote(what)
        overrides = ()
    text = catalog.describe(what, overrides, model)
    if figure is not None:
        kind = catalog.find_kind(what)
        if kind != "track":
            raise InputError(f"--figure has no effect: {what} is a {kind}, not a track")
        track = catalog.read_track(what)
        save_figure(trajectory_figure([], track.gates, track.name), figure)
    print(text)
    wrote(figure)
    for kind, path in [] if Path(what).exists() else list(catalog.find_files(what).items())[1:]:
        note(f"{what} is also a {kind}: {quadjax_command('show', path)}")


def listing() -> str:
    """Names and descriptions of what comes with the package."""
    lines = []
    for folder, kind in KINDS.items():
        names = preset_names(folder)
        width = max(map(len, names))
        lines += [textwrap.fill(f"{kind}:", 79)]
        for name in names:
            start = f"  {name:<{width}}  "
            text = _description(CONFIGS / folder / f"{name}.yaml")
            lines.append(textwrap.fill(start + text, 79, subsequent_indent=" " * len(start)))
        lines.append("")
    policies = textwrap.fill(", ".join(policy_names()), 77)
    return "\n".join([*lines, "policies:", textwrap.indent(policies, "  ")])


def _description(path: Path) -> str:
    """The first sentence of the comment at the top of a file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = itertools.takewhile(lambda line: line.startswith("#"), lines)
    text = " ".join(line.lstrip("# ") for line in comment)
    return re.split(r"(?<!et al)\. ", text)[0].removesuffix(".")
