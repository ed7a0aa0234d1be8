"""Write the tables of docs/design/results.md from benchmarks/results.json (make results).

``python -m benchmarks.results measure ROW POLICY...`` evaluates files or folders of runs first.
"""

import json
import math
import re
import statistics
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import fill

import quadjax
from quadjax.cli import script
from quadjax.core.errors import InputError
from quadjax.core.markdown import table

ROOT = Path(__file__).resolve().parents[1]
FILE, PAGE = ROOT / "benchmarks" / "results.json", ROOT / "docs" / "design" / "results.md"
BLOCK = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
CONDITIONS = ("mean", "sampled", "mean, random", "sampled, random")


def spread(values: list[float] | None) -> str:
    """Median and range; the number alone if there is one."""
    if not values:
        return "-"
    median, low, high = (f"{of(values):.2f}" for of in (statistics.median, min, max))
    return median if len(values) == 1 else f"{median} ({low}-{high})"


def finished(row: dict, condition: str) -> str:
    """Number of flights that finish, of those of all seeds."""
    counts = row["finished"].get(condition)
    return f"{sum(counts)}/{row['flights'] * len(counts)}" if counts else "-"


COLUMNS: dict[str, Callable[[dict], str]] = {
    **{key: lambda row, key=key: row[key] for key in ("policy", "race", "trained with", "time")},
    "name": lambda row: f"`{row['name']}`",
    **{f"{c}, s": lambda row, c=c: spread(row["total"].get(c)) for c in CONDITIONS},
    "hover": lambda row: finished(row, "sampled"),
    "random starts": lambda row: finished(row, "sampled, random"),
    "10^6 steps": lambda row: f"{row['steps'] / 1e6:.1f}",
    "noise": lambda row: f"{statistics.median(row['noise']):.2f}" if "noise" in row else "-",
    **{
        c: lambda row, c=c: f"{spread(row['total'][c])} ({row['finished'][c][0]})"
        for c in CONDITIONS
    },
}
TABLES = {  # of the page: rows and columns
    "presets": ("presets", "name|mean, s|sampled, s|hover|random starts"),
    "training": ("presets", "name|trained with|10^6 steps|noise|time"),
    "shipped": ("shipped", "name|noise|mean|sampled|sampled, random"),
    "table1": ("table1", "policy|sampled, s|mean, s|hover|random starts"),
    "published": ("published", "name|noise|mean|sampled|mean, random|sampled, random"),
}


def render(data: dict[str, list], page: str) -> str:
    """The page with the tables of the data."""
    made = {"body": table(data["body"])}  # cells as they are
    for name, (rows, titles) in TABLES.items():
        lines = [[COLUMNS[title](row) for title in titles.split("|")] for row in data[rows]]
        made[name] = table([titles.split("|"), *lines])
    rows = [row for rows, _ in TABLES.values() for row in data[rows] if "machine" in row]
    pairs = [(f"`{row['commit']}`, {row['machine']}", f"`{row['name']}`") for row in rows]
    groups = {key: dict.fromkeys(name for k, name in pairs if k == key) for key, _ in pairs}
    lines = [f"- {key}: {', '.join(names)}" for key, names in groups.items()]
    made["measured"] = "\n".join(fill(line, 100, subsequent_indent="  ") for line in lines)
    return BLOCK.sub(lambda match: f"{match[1]}\n{made[match[2]]}\n\n{match[3]}", page)


def measure(row: dict, policies: Sequence[str]) -> None:
    """Replace the numbers of a row by those of policies."""
    runs = [quadjax.Run.load(path) for path in policies if Path(path).is_dir()]
    loaded = [run.policy for run in runs] or [quadjax.Policy.load(path) for path in policies]
    race, options = quadjax.load(row["race"]), row.get("options", {})
    flown = [quadjax.evaluate(p, race, conditions="protocols", **options) for p in loaded]
    named = {name: [flights[name] for flights in flown] for name in CONDITIONS}
    row["commit"] = subprocess.getoutput("git describe --always --dirty --abbrev=7")
    row |= {"machine": flown[0].provenance["device"], "flights": flown[0].rows[0].runs}
    row["noise"] = [round(math.exp(p.log_std.mean()), 2) for p in loaded]
    row["total"] = {name: [round(r.total, 2) for r in rows] for name, rows in named.items()}
    row["finished"] = {name: [r.finished for r in rows] for name, rows in named.items()}
    if runs:
        row |= {"seeds": [run.config.seed for run in runs], "steps": runs[0].summary["steps"]}
        low, *_, high = sorted(run.summary["seconds"] for run in runs)
        row["time"] = f"{low:.0f}-{high:.0f} s"
        devices = {run.summary["provenance"]["device"] for run in runs} - {row["machine"]}
        row["machine"] = "; trained on ".join([row["machine"], *sorted(devices)])


def results(*words: str) -> None:
    """Measure the row that is named, if any, and write file and page."""
    data = json.loads(FILE.read_text(encoding="utf-8"))
    if words:
        rows = {row["name"]: row for part in data.values() for row in part if "name" in row}
        if words[0] != "measure" or len(words) < 3 or words[1] not in rows:
            raise InputError(f"{words[0]}: allowed: measure ROW POLICY..., ROW: {', '.join(rows)}")
        measure(rows[words[1]], words[2:])
        parts = [f'"{k}": [\n' + ",\n".join(map(json.dumps, v)) + "\n]" for k, v in data.items()]
        FILE.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")
    PAGE.write_text(render(data, PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    script(results)
