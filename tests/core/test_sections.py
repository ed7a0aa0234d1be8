"""The base of all configs: reading, composing, building and one-line errors."""

import shlex
from typing import Annotated, Literal

import pytest
import yaml

from quadjax.config.reference import describe
from quadjax.core.errors import InputError
from quadjax.core.sections import Field, Section, model_validator, validate
from quadjax.core.yaml_files import override, parse_overrides, parse_yaml, read_yaml, to_yaml
from quadjax.core.yaml_layers import read_tree_with_bases


class Span(Section):
    begin: float = Field(0.0, ge=0, description="s")
    end: float = Field(alias="until", default=1.0, gt=0, le=3)


class Point(Section):
    position: tuple[float, float]


class Example(Section):
    count: int = Field(3, ge=1, le=4096, description="a number of things")
    flag: bool = False
    label: str = ""
    method: Literal["tpe", "grid"] = "tpe"
    widths: tuple[int, ...] = Field((64,), min_length=1, max_length=3)
    factors: dict[str, float] = {}
    limit: float | None = Field(None, gt=0)
    sizes: tuple[Annotated[float, Field(gt=0, le=5)], ...] = ()
    points: tuple[Point, ...] = ()
    span: Span = Span()
    spans: dict[str, Span] = {}

    @model_validator(mode="after")
    def _check(self) -> "Example":
        if self.flag and self.limit is None:
            raise ValueError("limit is None, allowed: a number with flag=true")
        return self


def test_build_takes_what_is_meant():
    tree = {"count": 2e3, "widths": [1, 2.0], "limit": 3, "span": {"until": 2}, "factors": {"a": 1}}
    example = validate(Example, tree, "f.yaml")
    assert (example.count, example.widths, example.limit) == (2000, (1, 2), 3.0)
    assert isinstance(example.count, int) and isinstance(example.widths[1], int)
    assert example.span.end == 2.0 and example.factors == {"a": 1.0}
    assert Example(count=2e3).count == 2000 and example.replace(count=5).count == 5
    with pytest.raises(InputError, match="^f.yaml: learner.count is 0, allowed: greater"):
        validate(Example, {"count": 0}, "f.yaml", prefix="learner.")


REFUSED = [
    ({"sizes": [9]}, "sizes[0] is 9, allowed: less than or equal to 5"),
    ({"count": 2.5}, "count is 2.5, allowed: a whole number"),
    ({"count": True}, "count is true, allowed: a whole number"),
    ({"count": 0}, "count is 0, allowed: greater than or equal to 1"),
    ({"count": 10**5000}, "count is a number of thousands of digits, allowed: "),
    ({"factors": 3}, "factors is 3, allowed: a mapping"),
    ({"limit": "1"}, "limit is '1', allowed: a number"),
    ({"label": 3}, "label is 3, allowed: text"),
    ({"flag": "true"}, "flag is 'true', allowed: true or false"),
    ({"method": "cma"}, "method is 'cma', allowed: 'tpe' or 'grid'"),
    ({"widths": []}, "widths is [], allowed: at least 1 item"),
    ({"widths": 3}, "widths is 3, allowed: a list"),
    ({"limit": float("nan")}, "limit is nan, allowed: a finite number"),
    ({"points": [{"position": [1]}]}, "points[0].position[1] is missing"),
    ({"points": [{"positoin": [1, 2]}]}, "unknown key points[0].positoin; did you mean position?"),
    ({"span": 3}, "span is 3, allowed: a mapping"),
    ({"counts": 3}, "unknown key counts; did you mean count?; allowed there: count, factors,"),
    ({"flag": True}, "limit is None, allowed: a number with flag=true"),
]


@pytest.mark.parametrize(("tree", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_build_refuses_in_one_line(tree, message):
    with pytest.raises(InputError) as caught:
        validate(Example, tree, "f.yaml")
    text = str(caught.value)
    assert text.startswith(f"f.yaml: {message}") and "\n" not in text


def test_yaml_is_version_1_2():
    text = "a: 1e-3\nb: yes\nc: 2026-01-31\nd: 0o10\ne: 1_000\nf: 010\ng: null\nh: true\ni: .5"
    values = (1e-3, "yes", "2026-01-31", 8, 1000, 10, None, True, 0.5)
    assert parse_yaml(text, "t") == dict(zip("abcdefghi", values, strict=True))
    assert parse_yaml("${oc.env:HOME}", "t") == "${oc.env:HOME}"


UNREADABLE = {
    "a: 1\na: 2": 'line 2: found duplicate key "a"',
    "a: &a [*a]": "nested too deep",
    "\n".join(["a0: &a0 [1, 2]", *(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]" for n in range(1, 40))]): (
        "more than 1,000,000 values, with those of aliases"
    ),
    "a: " + "9" * 5000: "not YAML of plain values (Exceeds the limit",
    "a: !!python/object:os.system x": "line 1: could not determine a constructor",
    "- 1": "expected a mapping",
    "x: \x00": "is binary data, expected text",
    "x: \x01": "not YAML",
}


@pytest.mark.parametrize(("text", "message"), UNREADABLE.items(), ids=UNREADABLE.values())
def test_read_yaml_refuses_in_one_line(tmp_path, text, message):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_yaml(path)
    assert str(caught.value).startswith(f"{path}:") and message in str(caught.value)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_bases_compose_in_order(tmp_path):
    (tmp_path / "a.yaml").write_text("x: {p: 1, q: 1, r: 1}\nd: [1]")
    (tmp_path / "b.yaml").write_text("x: {q: 2, r: 2}\nd: [4]")
    (tmp_path / "c.yaml").write_text("base: [a.yaml, b]\nx: {r: 3}\ny: 4")
    tree = {"x": {"p": 1, "q": 2, "r": 3}, "d": [4], "y": 4}
    assert read_tree_with_bases(tmp_path / "c.yaml") == tree


def test_bases_refused(tmp_path):
    (tmp_path / "link.yaml").symlink_to(tmp_path / "link.yaml")
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    for index in range(25):
        (tmp_path / f"n{index}.yaml").write_text(f"base: n{index + 1}.yaml")
    for base, message in (
        ("c.yaml", "leads back to itself"),
        ("none", "no such file"),
        ("[1]", r"allowed: a file name or a list"),
        ("link.yaml", "link"),
        ("zero.yaml", "not a regular file"),
        ("n0.yaml", "a chain of more than 20"),
    ):
        (tmp_path / "c.yaml").write_text(f"base: {base}")
        with pytest.raises(InputError, match=message):
            read_tree_with_bases(tmp_path / "c.yaml")


def test_overrides():
    parsed = parse_overrides(["a.b=1e3", "a.c=[1, 2]", "x=null", "y=true", "z=a=b"])
    assert parsed == {"a": {"b": 1e3, "c": [1, 2]}, "x": None, "y": True, "z": "a=b"}
    for word in ("a", "=3", "a..b=3", ".=1", ".".join("a" * 2000) + "=1"):
        with pytest.raises(InputError, match="is not of the form key=value"):
            parse_overrides([word])


LITERAL = (
    *("LOG 1 #2.csv", "#1.yaml", "*.csv", "@e.csv", "&a b", "&a", "!x", "!!int 3", "%a", "`a"),
    *("a: b", "- a", "? a", "--- 1", "1 #2", "> a", "| a", "a, b", "=", "~/a.yaml", "2026-01-31"),
    *("a's", 'a"b', "a{b}", "a[1]", "null #1", "ä ö"),
)


@pytest.mark.parametrize("text", LITERAL)
def test_the_text_of_an_override_is_taken_as_it_is(text):
    assert parse_overrides([f"file={text}"]) == {"file": text}
    assert parse_overrides([override("file", text)]) == {"file": text}


@pytest.mark.parametrize(
    "text", ["{x}.csv", "[a] 1.csv", "[1] #2", "'a' b", "[1], [2]", '"a', "{a"]
)
def test_an_override_that_is_neither_asks_for_quotes(text):
    with pytest.raises(InputError, match="as a text with quotes: ") as caught:
        parse_overrides([f"a.file={text}"])
    (quoted,) = shlex.split(str(caught.value).partition("quotes: ")[2])
    assert parse_overrides([quoted]) == {"a": {"file": text}}


def test_to_yaml_reads_back(tmp_path):
    tree = {
        "points": [{"position": [1.0, 2e-7]}],
        "factors": {"a b": 1e30, "null": 1.0},
        "text": ["true", "1e3", "", "x: y", "é", "a/b.npz"],
        "none": None,
        "empty": {},
        "flag": False,
        "span": {"until": 1.5},
    }
    text = to_yaml(tree, {"span.until": "s"})
    assert "  # s\n  until: 1.5" in text
    (tmp_path / "c.yaml").write_text(text)
    assert read_yaml(tmp_path / "c.yaml") == tree
    example = validate(Example, {"points": [{"position": [1, 2]}]}, "f")
    dumped = to_yaml(example.model_dump(by_alias=True))
    assert validate(Example, parse_yaml(dumped, "t"), "t") == example


def test_describe_lists_every_key():
    found = {info.key: info for info in describe(Example)}
    assert found["count"].description == "a number of things" and found["count"].default == 3
    assert found["span.until"].allowed == "a number, above 0, at most 3"
    assert "span" not in found


def test_small_numbers_are_numbers_in_yaml_1_1_too():
    """YAML 1.1 reads 1e-05, without a point, as text."""
    numbers = [1e-05, -2e-07, 2.5e-06, 1e20, 0.5]
    text = to_yaml({"k": 1e-05, "list": numbers})
    assert "k: 1.0e-05" in text
    assert yaml.safe_load(text) == {"k": 1e-05, "list": numbers} == parse_yaml(text, "text")
