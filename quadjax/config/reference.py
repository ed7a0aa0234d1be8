"""The reference of every config key, from the declarations: a page of the docs, and comments."""

from quadjax.config.schema import Config, Gate, Schedule
from quadjax.core.markdown import table
from quadjax.core.sections import KeyInfo, Section, describe
from quadjax.core.yaml_files import to_yaml
from quadjax.learners.ppo.hyperparameters import PPO
from quadjax.learners.shac.hyperparameters import SHAC

LEARNERS: tuple[type[Section], ...] = (PPO, SHAC)


def commented_yaml(config: Config) -> str:
    """A config as YAML with its notes and the description of each key on the line above it."""
    keys = describe(Config) + describe(type(config.learner), "learner.")
    comments = {info.key: f"{info.description} [{info.allowed}]" for info in keys}
    for location, (text, number) in config.race_units.items():
        key = ".".join(part for part in location if isinstance(part, str))
        comments[key] = f"{comments.get(key, '')} {text}: {number:g}".lstrip()
    notes = "".join(f"# {note}\n" for note in config.notes)
    return notes + to_yaml(config.to_tree(), comments)


def training_sections() -> list[tuple[str, list[KeyInfo]]]:
    """Every key of a training config, by the title of its table."""
    sections = [("The run", [info for info in describe(Config) if "." not in info.key])]
    for name, field in Config.model_fields.items():
        schema = field.annotation
        if isinstance(schema, type) and issubclass(schema, Section) and name != "learner":
            sections.append((f"`{name}`", describe(schema, f"{name}.")))
            if name == "track":
                sections.append(("Items of `track.gates`", describe(Gate)))
        elif name == "learner":
            for learner in LEARNERS:
                default = learner.model_fields["algorithm"].default
                title = f"`learner` with `learner.algorithm: {default}`"
                sections.append((title, describe(learner, "learner.")))
        elif name == "schedules":
            sections.append(("Values of `schedules`", describe(Schedule)))
    return sections


def sections_of(schema: type[Section], title: str) -> list[tuple[str, list[KeyInfo]]]:
    """Every key of another schema: its own keys, and a table for each section in it."""
    keys = describe(schema)
    groups = dict.fromkeys(info.key.rpartition(".")[0] for info in keys)
    return [
        (f"`{group}`" if group else title, [k for k in keys if k.key.rpartition(".")[0] == group])
        for group in groups
    ]


def markdown(title: str, sections: list[tuple[str, list[KeyInfo]]]) -> str:
    """A page of reference as Markdown: one table for each section."""
    parts = [f"## {name}\n\n{_table(keys)}" for name, keys in sections]
    return f"# {title}\n\n" + "\n".join(parts)


def _table(keys: list[KeyInfo]) -> str:
    rows = [("key", "default", "values", "description")]
    for info in keys:
        default = to_yaml({"": info.default}).strip().removeprefix('"": ')
        rows.append((f"`{info.key}`", f"`{default}`", info.allowed, info.description))
    return table(rows) + "\n"
