"""Damage to files: bytes that are replaced, removed or put between others."""

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

PIECES = (
    [b"1e999", b"nan", b"-1", b"null", b"true", b"9" * 5000, b"'", b"\n", b"\t", b",", b"[", b"{"]
    + [b": ", b"- ", b"? ", b"|", b"&a [*a]", b"*b", b"!!python/object:os.system x"]
    + [b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"../../x", b"PK\x03\x04"]
)
SETTINGS = settings(
    max_examples=40,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """The contents of a file with some of its bytes replaced."""
    changed = bytearray(whole)
    for _ in range(draw(st.integers(1, 5))):
        begin = draw(st.integers(0, len(whole)))
        length = draw(st.sampled_from((0, 1, 4, 30, 300, len(whole))))
        piece = draw(st.one_of(st.sampled_from(PIECES), st.binary(max_size=8), st.just(b"")))
        changed[begin : begin + length] = piece
    return bytes(changed)
