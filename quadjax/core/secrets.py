"""Passwords in text and in the URLs of databases."""

import re
from urllib.parse import unquote, unquote_plus

DATABASE = re.compile(  # a PostgreSQL URL; host and database may be shown
    r"postgresql://([^@/?#\s]*@)?(?P<place>(\[[\da-fA-F:.]+\]|[^@/?#:\s]*)(:\d+)?(/[^@/?#\s]*)?)"
    r"(\?(?P<query>[^@?#\s]*))?"
)
_SECRET = re.compile(
    r"(?P<url>(?!://USER:PASSWORD@HOST:PORT/)://[^\s:/@]*:)"  # not of the message of the form
    r"(?:\S*(?=@)|(?!\d{1,5}(?:[^\w.]|$))\S+)"  # a port is shown
    r"|(?P<key>\b(?:pass|pwd|secret|token)\w*\s*=\s*)(?:'[^']*'?|\"[^\"]*\"?|[^\s&'\"]+)",
    re.IGNORECASE,
)


def redact(text: str) -> str:
    """The text with ``***`` in place of passwords in URLs and values such as ``password=..``."""
    return _SECRET.sub(lambda found: f"{found['url'] or found['key']}***", text)


def hide(text: str, url: str) -> str:
    """The text without the password of a database's URL, its parameters, and the URL itself.

    Args:
        text: for example of an error.
        url: of the form ``DATABASE``.
    """
    found = DATABASE.fullmatch(url)
    own = [(found[1] or "").rstrip("@").partition(":")[2]] if found else []
    own += [entry.partition("=")[2] for entry in (found and found["query"] or "").split("&")]
    secrets = {url, *own, *map(unquote, own), *map(unquote_plus, own)} - {""}
    for secret in sorted(secrets, key=len, reverse=True):
        text = text.replace(secret, "***")
    return redact(text)
