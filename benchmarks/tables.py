"""The tables of the documentation: of which rows, and with which columns."""

from collections.abc import Callable
from typing import NamedTuple

from benchmarks.best_laps import DRONES
from benchmarks.betaflight_tables import BETAFLIGHT
from benchmarks.columns import BODIES, COUNTS
from benchmarks.comparison_tables import contenders, effects, lead_rows, steps
from benchmarks.data_tables import (
    AGAIN,
    INDI,
    ablations,
    best_laps,
    laps_of_policies,
    of_seeds_or_indi,
)
from benchmarks.plant_tables import CHARGES, Data, charged, looped, unchanged
from benchmarks.settings import Tree
from benchmarks.steps import CHARGED, PARTS, STEPS

README = {"e2e": "the published reward", "e2e +fastest": "time only"}


class Table(NamedTuple):
    """The file of a table's rows, its columns, and a choice of rows; all of the file without it.

    ``file`` is empty for a table of other data.
    """

    file: str
    columns: str  # of COLUMNS, or keys of the row; each may have another title: TITLE=COLUMN
    rows: Callable[[Data], list[Tree]] | None = None


def with_bodies(data: Data) -> list[Tree]:
    """The shipped policies, each with its rows of flights with a body."""
    rows = {row["name"]: row for row in data["body"]}
    return [
        row | {body: rows[f"{row['name']} {body}"] for body in BODIES} for row in data["shipped"]
    ]


def of_readme(data: Data) -> list[Tree]:
    """The presets of the README, with a word on each."""
    rows = {row["name"]: row for row in data["presets"]}
    return [rows[name] | {"preset": f"`{name}`: {text}"} for name, text in README.items()]


BODY = "sampled|with a body=body|body and hall=hall|random starts"
BODY += "|random starts, with a body=random starts, body"
SCORED = "drones and seeds|score, s|of each seed, s|time, s|finished"
OF_PARTS = "E2E=contender|drones and seeds|score, s|of each seed, s|finished|simulated, s"
OF_CHARGES = "E2E=contender|score, s|of each seed, s"
OF_STEPS = "step=contender|score, s|of each seed, s|time, s|finished"
SIZES = "model=name|Fz mean / rms / largest, m/s^2=force|Mx, My, Mz rms, mN m=moments"
SIZES += "|Fz deviation=force deviation|deviations, mN m=moment deviations"
LOOP = "gains of=name|roll rate, ms=p|pitch rate, ms=q|yaw rate, ms=r|thrust, ms=T"
OF_EFFECTS = "|".join(f"{x}log-likelihood|{x}E2E|{x}INDI" for x in ("", AGAIN))
OF_DRONES = "|".join(["track", *DRONES.values()])
MEAN = "mean action=mean, s|sampled=sampled, s|finish from random starts=random starts"
TABLES = {
    "readme": Table("presets", f"preset|{MEAN}", of_readme),
    "presets": Table("presets", "name|mean, s|sampled, s|hover|random starts"),
    "training": Table("presets", "name|trained with|10^6 steps|noise|time"),
    "pretrained": Table("shipped", "file|race|seed|mean, s|random starts"),
    "shipped": Table("shipped", "file|noise|mean|sampled|sampled, random"),
    "table1": Table("table1", "policy|sampled, s|mean, s|hover|random starts"),
    "published": Table("published", "name|noise|mean|sampled|mean, random|sampled, random"),
    "body": Table("body", f"file|{BODY}", with_bodies),
    "plant": Table("plant", "name|noise|mean action=mean|sampled", unchanged),
    "loop": Table("plant", "inner loop|time and finished=sampled loop", looped),
    "charge": Table("plant", "name|" + "|".join(CHARGES), charged),
    "tournament": Table("tournament", f"contender|{SCORED}", contenders),
    "leads": Table("tournament", "lead of E2E|score, s|first lap, s|each later lap, s", lead_rows),
    "interventions": Table("interventions", OF_STEPS, lambda data: steps(data, STEPS)),
    "without": Table("interventions", OF_PARTS, lambda data: steps(data, PARTS)),
    "emptied": Table("interventions", OF_CHARGES, lambda data: steps(data, CHARGED)),
    "instructions": Table("instructions", "policy=file|build|" + "|".join(COUNTS)),
    "size": Table("size", SIZES),
    "identify": Table("identify", LOOP),
    "hover": Table("hover", "name|10^6 steps|caught, %"),
    "laps": Table("", f"{OF_DRONES}|{INDI}", best_laps),
    "tracks": Table("tracks", OF_DRONES, laps_of_policies),
    "racing": Table("tracks", "name|lap, s|gap, %|crashed, %", of_seeds_or_indi),
    "robust": Table("robust", "trained for|±0%|±10%|±20%|±30%"),
    "cyberzoo": Table("cyberzoo", "flights=policy|lap 1|laps 2 to 6|six laps|finished=completed"),
    "posterior": Table("posterior", "number=name|range|median|90%"),
    "ablations": Table("", f"without|{OF_EFFECTS}", ablations),
    "effects": Table("interventions", "from|to|trainings|saved, s", effects),
    **{name: Table(*table) for name, table in BETAFLIGHT.items()},
}
