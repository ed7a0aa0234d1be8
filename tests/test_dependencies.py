"""Packages depend on each other in one direction."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1] / "quadjax"
# Each package, or module, and what it may import. The command line may import everything.
CONFIG = {"core", "vehicle", "race", "learners"}
ALLOWED = {
    "core": set(),
    "vehicle": {"core"},
    "race": {"core", "vehicle"},
    "learners": {"core"},
    "config": CONFIG,
    "policy": CONFIG | {"config"},
    "training": CONFIG | {"config", "policy"},
    "flights": {"core", "vehicle", "race"},
    "view": {"core", "race", "flights"},
    "evaluation": CONFIG | {"config", "policy", "training", "view", "flights", "plant", "fitting"},
    "export": CONFIG - {"learners"} | {"config", "policy"},
    "fitting": {"core", "vehicle", "flights"},
    "limits": {"core", "vehicle", "race", "config", "policy", "flights"},
    "integrations": {"core", "race", "config"},
    "plant": CONFIG - {"learners"} | {"config", "policy", "flights"},
    "replay": CONFIG - {"learners"}
    | {"config", "policy", "flights", "fitting", "evaluation", "export"},
    "sweeps": CONFIG | {"config", "policy", "training", "evaluation", "plant"},
    "sil": CONFIG - {"learners"}
    | {"config", "policy", "evaluation", "plant", "export", "flights", "fitting"},
}


def _imported(path):
    """Packages of quadjax that a module imports."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
            if node.module == "quadjax":
                names = [f"quadjax.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "quadjax" and len(parts) > 1 and parts[1] != "__version__":
                yield parts[1]


def test_packages_depend_on_each_other_in_one_direction():
    found = {package: set() for package in ALLOWED}
    for package in ALLOWED:
        for path in sorted((ROOT / package).rglob("*.py")) or [ROOT / f"{package}.py"]:
            found[package] |= set(_imported(path)) - {package}
    assert all(found[package] for package in ALLOWED if package != "core")
    wrong = {package: found[package] - ALLOWED[package] for package in ALLOWED}
    assert not {package: names for package, names in wrong.items() if names}


def test_every_package_is_in_the_table():
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert packages - {"cli"} <= set(ALLOWED)


WITHOUT_CONFIG = (
    *("core", "vehicle", "race", "learners", "policy", "integrations"),
    *("fitting", "plant"),
)
# Public functions that also take a preset's name.
EDGES = {"race_of_policy", "import_policy", "_make", "_make_vector"}
EDGES |= {"plan_race", "race_config", "plan_logs"}  # flights of a race on the plant
EDGES |= {"own_race", "differences", "warn_of_other_race"}  # two races next to each other


def test_only_the_outer_packages_take_a_whole_config():
    """The others take an environment and its params, a policy, gates, or a single number."""
    taking = set()
    for package in WITHOUT_CONFIG:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef):
                    types = [ast.unparse(a.annotation) for a in node.args.args if a.annotation]
                    whole = {"Config", "Named"}
                    if whole & {word.strip() for text in types for word in text.split("|")}:
                        taking.add(node.name)
    assert taking == EDGES
