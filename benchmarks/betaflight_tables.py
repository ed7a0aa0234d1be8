"""Rows of the tables of docs/design/betaflight.md, from those of benchmarks.betaflight."""

from benchmarks.betaflight_contenders import CONTENDERS, DRONES
from benchmarks.settings import Tree

FLOWN = {"own model": "its own model", "default": "Betaflight", "tuned": "Betaflight, tuned"}


def flights(data: dict[str, list[Tree]]) -> list[Tree]:
    """A line for each drone, contender and what it flew in: of all seeds."""
    made = []
    for drone in DRONES:
        for contender in CONTENDERS:
            rows = [
                r for r in data["betaflight"] if (r["drone"], r["contender"]) == (drone, contender)
            ]
            for key, title in FLOWN.items():
                if flown := [row["flown"][key] for row in rows if key in row["flown"]]:
                    made.append(
                        {"drone": drone, "contender": contender, "flown in": title} | of(flown)
                    )
    return made


def of(flown: list[Tree]) -> Tree:
    """What a table shows of the flights of several seeds."""
    done = [flight for flight in flown if not flight["end"]]
    saturated = [100.0 * flight["saturated"] for flight in flown if "saturated" in flight]
    return {
        "six laps, s": [sum(flight["laps"]) for flight in done],
        "each later lap, s": [sum(flight["laps"][1:]) / len(flight["laps"][1:]) for flight in done],
        "finished": f"{len(done)}/{len(flown)}",
        "saturated, %": saturated,
        "tau_rate, ms": [1e3 * flight["tau_rate"] for flight in done if "tau_rate" in flight],
    }


def fitted(lines: list[Tree]) -> list[Tree]:
    """Those of flights through Betaflight."""
    return [line for line in lines if line["saturated, %"]]


def responses(data: dict[str, list[Tree]]) -> list[Tree]:
    """Dead time and lag of each axis, in ms, by drone and gains."""
    return [
        row
        | {
            axis: f"{1e3 * row[axis]['dead time']:.0f} + {1e3 * row[axis]['lag']:.0f}"
            for axis in ("roll", "pitch", "yaw", "thrust")
        }
        for row in data["betaflight_response"]
    ]


BETAFLIGHT = {  # file, columns and rows of each table
    "betaflight": (
        "betaflight",
        "drone|policy=contender|flown in|six laps, s|each later lap, s|finished",
        flights,
    ),
    "lags": (
        "betaflight",
        "drone|policy=contender|flown in|tau_rate, ms|saturated, %",
        lambda data: fitted(flights(data)),
    ),
    "response": ("betaflight_response", "drone|gains|roll|pitch|yaw|thrust|error", responses),
}
