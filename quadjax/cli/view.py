"""``quadjax view``."""

import webbrowser
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.core.errors import InputError
from quadjax.core.files import write_json
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.flights.flight import Flight

SUFFIXES = (".html", ".npz", ".json")


def view(
    *flights: Annotated[str, Parameter(name="FLIGHTS", required=True)],
    output: Annotated[Path, opt.Output(SUFFIXES), Parameter(metavar="FILE.html")] = Path(
        "flights.html"
    ),
    name: list[str] | None = None,
    title: str | None = None,
    race: opt.Race = None,
    laps: opt.Laps | None = None,
    runs: opt.Runs = 1,
    sampled: opt.Flag = False,
    seed: opt.Seed = 0,
    logs: opt.Logs = opt.PLAIN_LOGS,
    open_: Annotated[opt.Flag, Parameter(name="--open")] = False,
) -> None:
    """Write flights as an interactive 3D page that opens without a server or network.

    A flight is a training run's folder, whose newest policy is shown while it
    trains, and the best one when it has finished; a policy file, or
    the name of one that comes with quadjax (e2e, e2e_fastest, indi, ..); states
    of quadjax evaluate --states FILE.npz; the best known lap of quadjax limit
    --npz FILE.npz; a flight log (.csv, .ulg); or flights that an earlier quadjax
    view --output FILE.npz wrote. Lap times (.json, of quadjax evaluate --json or
    limit --json) are marked on the time line. All flights start together.
    Policies fly their own race, or that of --race, with the mean action.

    Example: quadjax view e2e indi

    Args:
        flights: One or more, as above.
        output: Page, or its data (.json), or the flights (.npz).
        name: Name of the first of FLIGHTS; repeat it for the next ones.
        title: Title of the page (default: the flights, the drone and the track).
        race: Race of the policies, and gates that the logs pass.
        laps: Laps of policies (default: evaluate.laps).
        runs: Runs of each policy.
        sampled: Sampled actions of policies.
        seed: Seed of the noise.
        open_: Open the page in the browser.
    """
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.evaluation.sources import load_flights

    names = name or []
    if len(names) > len(flights):
        raise InputError(f"--name {names[-1]}: more names than flights")
    if open_ and output.suffix != ".html":
        raise InputError(f"--open needs an .html file, --output is {output}")
    config = load_config(race) if race else None
    columns = logs.columns() if logs.logs else None
    how: dict[str, Any] = {"runs": runs, "laps": laps, "deterministic": not sampled, "seed": seed}
    how |= {"race": config, "logs": columns}
    with steps() as report:
        labels = [*names, *[None] * (len(flights) - len(names))]
        groups = [
            load_flights(source, label, progress=report, **how)
            for source, label in zip(flights, labels, strict=True)
        ]
        read = _told_apart(flights, groups)
        count = _write(output, title, config.track.name if config else "", read)
    size = output.stat().st_size
    wrote(f"{output}: {count} flight{'' if count == 1 else 's'}, {size / 2**20:.1f} MiB")
    if open_:
        webbrowser.open(output.resolve().as_uri())


def _told_apart(sources: Sequence[str], groups: "list[list[Flight]]") -> "list[Flight]":
    """All flights; a name that flights of several sources have is followed by the source.

    Of a source that is given more than once, it is also numbered.
    """
    uses = Counter(name for flights in groups for name in {f.name for f in flights if len(f.time)})
    origins = [
        f"{source} {sources[:index].count(source) + 1}" if sources.count(source) > 1 else source
        for index, source in enumerate(sources)
    ]
    return [
        f.replace(name=f"{f.name} ({origin})") if uses[f.name] > 1 and len(f.time) else f
        for origin, flights in zip(origins, groups, strict=True)
        for f in flights
    ]


def _write(output: Path, title: str | None, track: str, flights: "list[Flight]") -> int:
    """Write the page, its data or the flights, by the suffix; returns the number of flights."""
    with loading():
        from quadjax.flights import save
        from quadjax.view.data import make_title, page_record
        from quadjax.view.page import write_page

    record = page_record(title or make_title(flights, track), flights)
    if output.suffix == ".npz":
        save(flights, output)
    elif output.suffix == ".json":
        write_json(output, record)
    else:
        write_page(output, record)
    return len(record["flights"])
