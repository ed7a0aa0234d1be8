"""C from Jinja templates: the environment, literals, tables and comments."""

import functools
import re
from collections.abc import Iterable

import jinja2
import numpy as np

WIDTH = 100
RESERVED = frozenset(
    """
    auto break case char const continue default do double else enum extern float for goto if inline
    int long register restrict return short signed sizeof static struct switch typedef union
    unsigned void volatile while
    alignas alignof bool constexpr false nullptr static_assert thread_local true typeof
    typeof_unqual
    asm catch class concept consteval constinit co_await co_return co_yield const_cast decltype
    delete dynamic_cast explicit export friend mutable namespace new noexcept operator private
    protected public reinterpret_cast requires static_cast template this throw try typeid typename
    using virtual wchar_t char8_t char16_t char32_t and and_eq bitand bitor compl not not_eq or
    or_eq xor xor_eq
    assert complex ctype errno fenv float inttypes iso646 limits locale main math memory setjmp
    signal stdalign stdarg stdatomic stdbit stdbool stdckdint stddef stdint stdio stdlib
    stdnoreturn string tgmath threads time uchar wchar wctype
    stdin stdout stderr offsetof va_list va_arg va_start va_end isfinite isinf isnan isnormal
    signbit arm_neon autopilot cstdint cstdio far i386 linux module near state unistd unix
    """.split()
)


@functools.cache
def environment() -> jinja2.Environment:
    """The templates of this package; fields are written ``${name}``, statements ``{% .. %}``."""
    found = jinja2.Environment(
        loader=jinja2.PackageLoader("quadjax.export", "templates"),
        variable_start_string="${",
        variable_end_string="}",
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
        autoescape=False,
    )
    found.filters |= {
        "int32": literal,
        "int64": literal_64,
        "hex": lambda bits: f"0x{int(bits):08X}U",
        "number": lambda value: f"{value:g}",
        "short": lambda value: f"{value:.3g}",
        "float32": lambda value: f"{float(value)!r}F",
        "unsigned": lambda value: f"{value}U",
        "wrapped": wrapped,
        "comment": comment,
        "string": string,
        "each": lambda values, convert: [found.filters[convert](v) for v in np.ravel(values)],
    }
    found.globals |= {"table": table, "rows": rows, "zip": zip}
    return found


def render(template: str, values: dict[str, object]) -> str:
    """A template of this package as text, without trailing blanks or repeated blank lines.

    Raises:
        jinja2.UndefinedError: the template has a field without a value.
    """
    text = environment().get_template(template).render(values)
    lines = [line.rstrip() for line in text.splitlines()]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)) + "\n"


def literal(value: int) -> str:
    """An int32 as C writes it; the most negative one has no literal of its own."""
    return str(int(value)) if value > -(2**31) else "(-2147483647 - 1)"


def literal_64(value: int) -> str:
    """An int64 as C writes it."""
    if value > -(2**63):
        return f"INT64_C({int(value)})"
    return "(-INT64_C(9223372036854775807) - 1)"


def wrapped(items: Iterable[str], indent: str = "    ") -> str:
    """Items with commas between them, in lines of at most ``WIDTH`` characters."""
    lines, line = [], indent
    for item in items:
        if len(line) + len(item) + 2 > WIDTH and line.strip():
            lines.append(line.rstrip())
            line = indent
        line += f"{item}, "
    lines.append(line.rstrip().removesuffix(","))
    return "\n".join(lines)


def table(kind: str, name: str, values: np.ndarray) -> str:
    """A ``static const`` table of one dimension."""
    write = literal_64 if kind == "int64_t" else literal
    body = wrapped(write(int(value)) for value in np.ravel(values))
    return f"static const {kind} {name}[{np.size(values)}] = {{\n{body}}};"


def rows(values: np.ndarray, convert: str) -> str:
    """The rows of a two-dimensional initializer; ``convert`` is the filter of each number."""
    write = environment().filters[convert]
    return ",\n".join(
        "    {" + wrapped(map(write, row), "     ").strip() + "}" for row in values.tolist()
    )


def comment(lines: Iterable[str]) -> str:
    """Lines as the inside of a block comment; nothing in them can end it."""
    return "\n".join(f" * {line.replace('*/', '* /')}".rstrip() for line in lines)


def string(text: str) -> str:
    """Text as a C string literal, printable ASCII only."""
    clean = "".join(c if 32 <= ord(c) < 127 else "?" for c in text)
    return '"' + clean.replace("\\", "\\\\").replace('"', '\\"').replace("?", "\\?") + '"'


def identifier(text: str) -> str:
    """Text as a lower-case C identifier that is no keyword and no name of the C library."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_") or "policy"
    return f"policy_{name}" if not name[0].isalpha() or is_reserved(name) else name


def shared_symbols(sources: Iterable[str], name: str, placeholder: str) -> list[str]:
    """Symbols that a prefix ``name`` would share with other words of the C.

    Args:
        sources: C with the prefix ``placeholder``.
        name: the prefix to check.
        placeholder: a prefix that occurs nowhere else.
    """
    words = {word for text in sources for word in re.findall(r"[A-Za-z_]\w*", text)}
    own = {word for word in words if word.lower().startswith(f"{placeholder}_")}
    renamed = {
        word.replace(placeholder, name).replace(placeholder.upper(), name.upper()) for word in own
    }
    return sorted(renamed & (words - own))


def is_reserved(name: str) -> bool:
    """Whether a prefix collides with a C or C++ keyword, a standard header or ``name_t`` type."""
    return name in RESERVED or bool(re.fullmatch(r"u?int(_?(fast|least|max|ptr))?\d*(_t)?", name))
