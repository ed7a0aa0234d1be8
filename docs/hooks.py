"""Pages that MkDocs generates from the package: config keys, help of commands, flights in 3D."""

import contextlib
import dataclasses
import inspect
import io
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from quadjax.config.loading import LEARNERS
from quadjax.config.reference import KeyInfo, describe
from quadjax.config.schema import Config, Schedule
from quadjax.core.markdown import table
from quadjax.core.sections import Section
from quadjax.core.yaml_files import to_yaml
from quadjax.race.track import GateSection
from quadjax.vehicle.constants import KEY, Declaration
from quadjax.vehicle.protocol import Signal


def on_page_markdown(markdown: str, **_: object) -> str:
    """Leave out links to examples, which the page includes; they are for readers of the file."""
    return re.sub(r"\[([^]]+)\]\(\.\./\.\./examples/[^)]+\)", r"\1", markdown)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages of the reference."""
    pages = {
        "reference/config.md": config_page,
        "reference/fit_config.md": fit_page,
        "reference/plant_config.md": plant_page,
        "reference/sweep_file.md": sweep_page,
        "reference/vehicle_file.md": vehicle_page,
        "reference/conditions.md": conditions_page,
        "reference/observation.md": observation_page,
        "reference/log_formats.md": log_formats_page,
        "reference/commands.md": commands_page,
    }
    for path, page in pages.items():
        if note := files.get_file_from_path(path):  # in the repository: says where the page is
            files.remove(note)
        files.append(File.generated(config, path, content=page()))
    for path in sorted((Path(__file__).parent / "gallery").glob("*.json")):
        name = f"gallery/{path.stem}.html"
        files.append(File.generated(config, name, content=flights_page(path)))
    return files


def flights_page(path: Path) -> str:
    """The 3D page of a file of flights."""
    from quadjax.core.files import read_json
    from quadjax.view.page import page

    return page(read_json(path))


def config_page() -> str:
    """Every key of a training config, by section."""
    return _page("Config keys", _training_sections())


def fit_page() -> str:
    """Every key of a fit's config, by section."""
    from quadjax.fitting.config import FitConfig

    return _page("Fit config keys", _sections_of(FitConfig, "The fit"))


def plant_page() -> str:
    """Every key of a plant's config, by section."""
    from quadjax.plant.config import PlantConfig

    return _page("Plant config keys", _sections_of(PlantConfig, "The plant"))


def sweep_page() -> str:
    """Every key of a sweep file, by section."""
    from quadjax.sweeps.schema import Range, SweepFile

    values = ("Values of `space`", describe(Range))
    return _page("Sweep file keys", [*_sections_of(SweepFile, "The sweep"), values])


def vehicle_page() -> str:
    """The equations and constants of every vehicle model, and the data of an airframe."""
    from quadjax.vehicle.airframe import Airframe
    from quadjax.vehicle.registry import MODELS

    parts = ["# Vehicle file keys", VEHICLES]
    for name, model in MODELS.items():
        fields = declared_fields(model.constants).items()
        rows = [[f"`{key}`", d.unit, d.group or "", d.sign] for key, d in fields]
        rows = [["constant", "unit", "group of `randomization`", "sign"], *rows]
        commands, states = _signals(*model.commands), _signals(model.actuators)
        told = f"Commands: {commands}. Actuators: {states}."
        parts += [f"## `{name}`", inspect.getdoc(type(model)) or "", told, table(rows)]
    parts += ["## Data of an airframe", WRITE, inspect.getdoc(Airframe) or ""]
    return "\n\n".join([*parts, _table(describe(Airframe))])


def conditions_page() -> str:
    """Every key of a list of conditions."""
    from quadjax.evaluation.conditions import Condition, Conditions, Damage

    sections = {"The list": Conditions, "A condition": Condition, "`damage`": Damage}
    return _page("Condition list keys", [(title, describe(s)) for title, s in sections.items()])


def observation_page() -> str:
    """The fields that policies of every vehicle model can observe."""
    from quadjax.race.observation_config import Observation
    from quadjax.race.observations import make_layout
    from quadjax.vehicle.registry import MODELS

    parts = ["# Observed fields", FIELDS]
    for name, model in MODELS.items():
        rows = [["field", "size", "unit", "frame", "range"]]
        for attitude in ("euler", "rotation"):
            observed = Observation(attitude=attitude, gates_ahead=2, last_action=True)
            for field in make_layout(model, observed, battery=name == "motor").fields:
                row = [
                    f"`{field.name}`",
                    str(field.size),
                    field.unit,
                    field.frame,
                    f"{field.range:g}",
                ]
                rows += [row] * (row not in rows)
        parts += [f"## `{name}`", table(rows)]
    return "\n\n".join(parts) + "\n"


def log_formats_page() -> str:
    """The columns, units and frames of every format of flight logs."""
    from quadjax.fitting import ulog
    from quadjax.fitting.formats import FORMATS, QUANTITIES, UNITS

    parts = ["# Log formats", COLUMNS]
    for name, form in FORMATS.items():
        rows = [["quantity", "columns", "unit"]]
        for quantity, columns in form.columns.items():
            kind = QUANTITIES[quantity].unit
            unit = form.units.get(kind, next(iter(UNITS[kind])) if kind else "")
            topic = (
                f" of `{ulog.SOURCES[quantity][0]}`"
                if name == "ulog" and quantity in ulog.SOURCES
                else ""
            )
            others = form.alternatives.get(quantity, ())
            texts = [
                ", ".join(f"`{c}`" for c in group) + f" ({form.column_units[group[0]]})"
                if group[0] in form.column_units
                else ", ".join(f"`{c}`" for c in group)
                for group in (columns, *others)
            ]
            rows.append([quantity, " or ".join(texts) + topic, unit])
        frames = f"Body frame {form.body_frame}, world frame {form.world_frame}."
        reader = ulog if name == "ulog" else form.adjust
        parts += [f"## `{name}`", frames, reader and inspect.getdoc(reader) or "", table(rows)]
    return "\n\n".join(parts) + "\n"


def _signals(*signals: Signal) -> str:
    return ", ".join(
        f"{s.size} {s.name.replace('_', ' ')}" + f", {s.unit}" * bool(s.unit) for s in signals
    )


def declared_fields(kind: type) -> dict[str, Declaration]:
    """The declaration of each field of a dataclass of constants."""
    fields = dataclasses.fields(kind)
    return {field.name: field.metadata.get(KEY, Declaration()) for field in fields}


VEHICLES = """\
A vehicle file has a mapping of constants for each model, and the optional keys of
[Your drone](../guide/race.md#drone). World frame north-east-down; body frame x forward, y right, z
down; motors 1 front-left, 2 front-right, 3 rear-right, 4 rear-left; 2 and 4 turn counter-clockwise
seen from above. `w'` is the derivative of `w`. A constant of the rotors is one number or a list;
`turning` lists `cw` or `ccw`, seen from above, for each rotor. `configs/vehicles/5inch.yaml` is a
complete file."""
FIELDS = """\
What a policy can observe ([Change the race](../guide/race.md#reward-observation-and-rule)):
`attitude` or `rotation`, more gates with `observation.gates_ahead`, and `last_action`,
`highest_rpm` and disturbances where they are configured. `range` is the largest magnitude of the
network's input, which the export assumes. Actuators and disturbances are scaled to -1 and 1."""
COLUMNS = """\
`logs.columns`, `logs.units`, `logs.body_frame`, `logs.world_frame` and `logs.motor_range` override
a format ([Fitting](../guide/fitting.md#logs)). Motors are in the order front-left, front-right,
rear-right, rear-left; names after "or" are used where a log lacks the first ones. Quaternions have
w first, rotation matrices nine elements. Of `paparazzi` only rows with `autopilot_mode > 0` are
used; body velocity is computed, and the accelerometer's bias subtracted. In `plain` logs commanded
speeds, attitude and position are optional."""
WRITE = """\
`quadjax show FILE --write vehicle KEY=VALUE ..` writes the constants of `motor`, `racing` and
`rate` from these data."""


def _training_sections() -> list[tuple[str, list[KeyInfo]]]:
    """Every key of a training config, by the title of its table."""
    tables = [table for table in _sections_of(Config, "The run") if table[0] != "`learner`"]
    for learner in LEARNERS.values():
        title = f"`learner` with `learner.algorithm: {learner.model_fields['algorithm'].default}`"
        tables.append((title, describe(learner, "learner.")))
    tables.append(("Items of `track.gates`", describe(GateSection)))
    tables.append(("Values of `schedules`", describe(Schedule)))
    return tables


def _sections_of(schema: type[Section], title: str) -> list[tuple[str, list[KeyInfo]]]:
    """Every key of another schema: its own keys, and a table for each section in it."""
    keys = describe(schema)
    groups = dict.fromkeys(info.key.rpartition(".")[0] for info in keys)
    return [
        (f"`{group}`" if group else title, [k for k in keys if k.key.rpartition(".")[0] == group])
        for group in groups
    ]


def _page(title: str, sections: list[tuple[str, list[KeyInfo]]]) -> str:
    """A page of reference as Markdown: one table for each section."""
    parts = [f"## {name}\n\n{_table(keys)}" for name, keys in sections]
    return f"# {title}\n\n" + "\n".join(parts)


def _table(keys: list[KeyInfo]) -> str:
    rows = [("key", "default", "values", "description")]
    for info in keys:
        default = to_yaml({"key": info.default}).strip().removeprefix("key: ")
        rows.append((f"`{info.key}`", f"`{default}`", info.allowed, info.description))
    return table(rows) + "\n"


def commands_page() -> str:
    """The help of every subcommand."""
    from quadjax.cli import COMMANDS, usage

    parts = ["# Commands", _block(usage())]
    for name in COMMANDS:
        parts += [f"## quadjax {name}", _block(_help(name))]
    return "\n\n".join(parts) + "\n"


def _help(command: str) -> str:
    """What ``--help`` of a subcommand prints."""
    from quadjax.cli import main

    stream = io.StringIO()
    with contextlib.redirect_stdout(stream), contextlib.suppress(SystemExit):
        main(command, ["--help"])
    return stream.getvalue()


def _block(text: str) -> str:
    return f"```text\n{text.strip()}\n```"
