"""Rows of the tables of shipped policies on ``cyberzoo``, from those of ``benchmarks.on_plant``."""

from benchmarks.settings import Tree

CHARGES = {f"charge {x}": f"battery.charge=[{x}, {x}]" for x in ("1.0", "0.6", "0.2")}
Data = dict[str, list[Tree]]


def text(row: Tree) -> str:
    """The time of the sampled flights, and how many finish."""
    total = row["total"]["sampled"][0]
    return f"{'-' if total is None else f'{total:.2f}'} ({row['finished']['sampled'][0]})"


def unchanged(data: Data) -> list[Tree]:
    """The shipped policies on the plant as it is."""
    return [row for row in data["plant"] if len(row["plant"]) == 1]


def charged(data: Data) -> list[Tree]:
    """The shipped policies with several charges of the battery."""
    made: dict[str, Tree] = {}
    for row in data["plant"]:
        for title, change in CHARGES.items():
            if row["plant"][1:] == [change]:
                made.setdefault(row["policy"], {"name": row["name"].split()[0]})[title] = text(row)
    return list(made.values())


def looped(data: Data) -> list[Tree]:
    """INDI with other numbers of the inner loop, after those of the plant."""
    made = []
    for row in (row for row in data["plant"] if row["policy"] == "indi_cyberzoo.npz"):
        change = row["plant"][1:]
        if not change or change[0].startswith("indi_simple."):
            made.append(
                {
                    "inner loop": f"`{change[0]}`" if change else "as flown",
                    "sampled loop": text(row),
                }
            )
    return made
