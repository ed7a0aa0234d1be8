"""Passwords in the URLs of databases."""

import re
from urllib.parse import unquote, unquote_plus

DATABASE = re.compile(  # a PostgreSQL URL; host and database may be shown
    r"postgresql://([^@/?#\s]*@)?(?P<place>(\[[\da-fA-F:.]+\]|[^@/?#:\s]*)(:\d+)?(/[^@/?#\s]*)?)"
    r"(\?(?P<query>[^@?#\s]*))?"
)


def hide(text: str, url: str) -> str:
    """The text without the password of a database's URL, its parameters, and the URL itself.

    Args:
        text: for example of an error.
        url: of the form ``DATABASE``.
    """
    match = DATABASE.fullmatch(url)
    values = [(match[1] or "").rstrip("@").partition(":")[2]] if match else []
    values += [entry.partition("=")[2] for entry in (match and match["query"] or "").split("&")]
    secrets = {url, *values, *map(unquote, values), *map(unquote_plus, values)} - {""}
    for secret in sorted(secrets, key=len, reverse=True):
        text = text.replace(secret, "***")
    return text
