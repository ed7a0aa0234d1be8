"""What ``quadjax.export_c`` refuses, in one line that names it."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS, PRETRAINED
from quadjax.export import flights
from quadjax.export.convert import export_c
from quadjax.export.names import symbol_name
from quadjax.export.network import convert
from quadjax.export.targets import RUNTIME
from quadjax.race.layout import Layout, ObservedField
from tests.export.support import config_of, made, random_rollouts

ALLOWED = {"allow_unfinished": True}


def export(folder, name="e2e", config=None, options=ALLOWED, **changes):
    """Export a made-up policy with other attributes, for its race with overrides."""
    race = None if config is None else config_of(name, *config)
    return export_c(dataclasses.replace(made(name)[0], **changes), folder, race, **options)


def weighted(value):
    """Layers whose weights are all large."""
    layers = made("e2e")[0].layers
    return {"layers": tuple((np.full_like(kernel, value), bias) for kernel, bias in layers)}


OTHER_GATES = "track.gates=[" + ", ".join(f"{{position: [{x}, 0, -1]}}" for x in (3, 0, 1, 2)) + "]"
EVERYTHING = "everything"
POLICIES = [  # words of the message, changes of the policy, its race or its export
    ("layer 1, row 0.* range proof fails", weighted(1e6)),
    ("layer 0, row 0.*unsupported", {"activation": "tanh"}),
    ("65535", {"command_high": np.full(4, 70000.0)}),
    (
        "battery is null, and .* observes highest_rpm",
        {"name": EVERYTHING, "config": ["battery=null"]},
    ),
    ("battery.* in training", {"name": EVERYTHING, "config": ["battery.charge=[0.5, 0.6]"]}),
    (
        "cut-off 4 Hz has no effect: .*'rate'",
        {"name": "indi", "options": ALLOWED | {"cutoff": 4.0}},
    ),
    (
        "the policy observes moment_ext, and INDIflight does not give sensors|models? is 'motor'",
        {"name": EVERYTHING, "options": ALLOWED | {"target": "indiflight"}},
    ),
    (
        "0.01 s, allowed: whole periods of 256",
        {"name": EVERYTHING, "options": ALLOWED | {"sample_rate": 256.0}},
    ),
    ("0 of 32 flights finish 6 laps of track square4 .*allow-unfinished", {"options": {}}),
] + [
    (f"trained in another race than config: {text}; --all", {"config": [override]})
    for text, override in (
        (r"track.gates\[0\].position is \[2.* in training, \[3.* here", OTHER_GATES),
        ("track is square4 in training, figure8 here", "track=figure8"),
        (
            "vehicle.constants.k_w is 4.36.*e-08 in training, 4e-08 here",
            "vehicle.constants.k_w=4e-8",
        ),
        ("rules.time_step is 0.01 in training, 0.005 here", "rules.time_step=0.005"),
        ("rules.gate_test is square in training, world_box here", "rules.gate_test=world_box"),
        (
            "vehicle.residual is null in .*, standin_residual.npz here",
            "vehicle.residual=standin_residual.npz",
        ),
    )
]


@pytest.mark.parametrize(("words", "changes"), POLICIES, ids=[words for words, _ in POLICIES])
def test_what_cannot_fly_its_race_is_refused(words, changes, tmp_path, no_flights):
    with pytest.raises(InputError, match=words) as caught:
        export(tmp_path / "c", **changes)
    assert "\n" not in str(caught.value) and not (tmp_path / "c").exists()


def test_an_observation_and_a_vehicle_of_a_user_have_no_c():
    policy, _ = made("e2e")
    wind = ObservedField("wind", 2, "m/s", "body")
    for changes, words in (
        ({"layout": Layout((*policy.layout.fields, wind))}, "'wind' .2 numbers., which has no C"),
        ({"vehicle": "mine"}, "vehicle model 'mine' has no C"),
    ):
        with pytest.raises(InputError, match=words):
            convert(dataclasses.replace(policy, **changes))


def test_shipped_policies_for_other_races_are_refused(tmp_path):
    for policy, config, words in (
        (
            PRETRAINED / "e2e_residual.npz",
            "e2e",
            "residual is standin_residual.npz in training, null here",
        ),
        (PRETRAINED / "indi.npz", CONFIGS / "e2e.yaml", "e2e.yaml: indi.npz: .*=rate, .*=motor,"),
    ):
        with pytest.raises(InputError, match=words):
            export_c(policy, tmp_path / "c", config)


def test_a_range_that_its_own_flights_leave_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(flights, "simulate", lambda own: random_rollouts(own, velocity=20.0))
    with pytest.raises(InputError, match=r"velocity.*20 m/s, declared \+-16.*velocity=32"):
        export(tmp_path / "c")
    export(tmp_path / "c", options=ALLOWED | {"ranges": {"velocity": 32.0}})


def test_rates_out_of_range_are_refused_before_anything_is_read(tmp_path):
    for rate in (0.0, -1.0, math.inf, math.nan, 1e300, 1e-300):
        for options, words in (
            ({"sample_rate": rate, "cutoff": rate}, "sample rate .* allowed: 1 to 100000 Hz"),
            ({"cutoff": rate}, "cut-off .* allowed: 0.512 to 128 Hz"),
        ):
            with pytest.raises(InputError, match=words):
                export_c(tmp_path / "none.npz", tmp_path / "c", **options)


def test_a_residual_that_the_policy_names_is_in_its_race(tmp_path, no_flights):
    exported = export_c(PRETRAINED / "e2e_residual.npz", tmp_path / "c", allow_unfinished=True)
    assert exported.converted.race.residual is not None
    shipped = (PRETRAINED / "standin_residual.npz").read_bytes()
    assert Path(tmp_path / "c/residual.npz").read_bytes() == shipped


@pytest.mark.parametrize(
    ("stem", "name"),
    [
        *(("math", "policy_math"), ("string", "policy_string"), ("Std-Int", "std_int")),
        *(("qj", "policy_qj"), ("state", "policy_state"), ("preflight_checks", None)),
        *(
            ("nul", "policy_nul"),
            ("7", "policy_7"),
            ("Flug über", "flug_ber"),
            ("\u98db", "policy"),
        ),
    ],
)
def test_no_file_of_an_export_has_the_name_of_a_header(stem, name):
    assert symbol_name(None, f"folder/{stem}.npz") == (name or f"policy_{stem}")


SOURCES = [path for path in RUNTIME.rglob("*") if path.suffix in (".c", ".h")]
INCLUDE = re.compile(r'#include\s*[<"](?:[\w/]*/)?(\w+)\.[ch][">]')
INCLUDED = {name for path in SOURCES for name in INCLUDE.findall(path.read_text("utf-8"))}


@pytest.mark.parametrize("name", sorted({"string", "state", "nul", "qj"} | INCLUDED))
def test_a_name_of_a_header_is_refused(name):
    """Also that of every file that the runtime or the glue includes."""
    assert len(INCLUDED) > 20
    with pytest.raises(InputError, match=f"choose another, such as policy_{name}"):
        symbol_name(name, "a.npz")
