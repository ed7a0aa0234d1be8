"""Pages that MkDocs generates from the package: config keys, help of commands, flights in 3D."""

import contextlib
import io
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages of the reference."""
    pages = {
        "reference/config.md": config_page,
        "reference/fit_config.md": fit_page,
        "reference/plant_config.md": plant_page,
        "reference/sweep_file.md": sweep_page,
        "reference/commands.md": commands_page,
    }
    for path, page in pages.items():
        files.append(File.generated(config, path, content=page()))
    for path in sorted((Path(__file__).parent / "gallery").glob("*.json")):
        name = f"gallery/{path.stem}.html"
        files.append(File.generated(config, name, content=flights_page(path)))
    return files


def flights_page(path: Path) -> str:
    """The 3D page of a file of flights."""
    from quadjax.core.files import read_json
    from quadjax.view.data import check_record
    from quadjax.view.page import page

    return page(check_record(path, read_json(path)))


def config_page() -> str:
    """Every key of a training config, by section."""
    from quadjax.config.reference import markdown, training_sections

    return markdown("Config keys", training_sections())


def fit_page() -> str:
    """Every key of a fit's config, by section."""
    from quadjax.config.reference import markdown, sections_of
    from quadjax.fitting.config import FitConfig

    return markdown("Fit config keys", sections_of(FitConfig, "The fit"))


def plant_page() -> str:
    """Every key of a stand-in plant's config, by section."""
    from quadjax.config.reference import markdown, sections_of
    from quadjax.plant.config import PlantConfig

    return markdown("Plant config keys", sections_of(PlantConfig, "The plant"))


def sweep_page() -> str:
    """Every key of a sweep file, by section."""
    from quadjax.config.reference import markdown, sections_of
    from quadjax.core.sections import describe
    from quadjax.sweeps.schema import Range, SweepFile

    values = ("Values of `space`", describe(Range))
    return markdown("Sweep file keys", [*sections_of(SweepFile, "The sweep"), values])


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
