"""Where a result comes from: versions, hashes of the inputs, seed, date and device."""

import contextlib
import datetime
import functools
import hashlib
import importlib.metadata
import json
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import pydantic

from quadjax import __version__
from quadjax.core.resources import PRETRAINED


def provenance(
    config: pydantic.BaseModel | None = None,
    policy: Path | str | None = None,
    seed: int | None = None,
) -> dict[str, Any]:
    """The origin of a result, for the key ``provenance`` of a JSON file.

    Args:
        config: the resolved config of the result: a ``Config`` or another section.
        policy: the policy file that was used, or a description of a policy without a file.
        seed: of the random numbers; that of the config if not given.

    Returns:
        ``quadjax`` and ``jax``, the versions; ``commit``, that of the checkout which quadjax runs
        from, with ``-dirty`` after changes, null for an installed package; ``config``, its name and
        the SHA-256 of its values; ``policy``, the file and its SHA-256 (null without a file);
        ``seed``; ``date``, UTC; and ``device``. ``config``, ``policy`` and ``seed`` are null where
        the result has none.
    """
    device = jax.devices()[0]
    return {
        "quadjax": __version__,
        "commit": commit(),
        "jax": importlib.metadata.version("jax"),
        "config": config and {"name": getattr(config, "name", None), "sha256": hash_config(config)},
        "policy": policy and file_record(policy),
        "seed": getattr(config, "seed", None) if seed is None else seed,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "device": processor() if device.platform == "cpu" else device.device_kind,
    }


@functools.cache
def commit() -> str | None:
    """The commit of the checkout that this package is in; None without one, or without Git."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40"]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        found = subprocess.run(
            [*command, "--exclude=*"], capture_output=True, text=True, timeout=10, check=True
        )
        return found.stdout.strip() or None
    return None


def describe_origin(origin: dict[str, Any]) -> str:
    """A ``provenance`` with a config as a line of text."""
    source = f" ({origin['commit']})" if origin["commit"] else ""
    versions = f"quadjax {origin['quadjax']}{source}, JAX {origin['jax']}, {origin['date']}"
    return f"{versions}; SHA-256 of the config: {origin['config']['sha256']}"


def file_record(path: Path | str) -> dict[str, str | None]:
    """A file and its SHA-256, null where there is no such file."""
    return {"file": str(path), "sha256": hash_file(path)}


def hash_config(config: pydantic.BaseModel) -> str:
    """SHA-256 of a config's values; ``.npz`` files are hashed by their content."""
    values = _by_content(config.model_dump(mode="json", by_alias=True))
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _by_content(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _by_content(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_by_content(item) for item in value]
    named = isinstance(value, str) and value.endswith(".npz")
    return (named and (hash_file(value) or hash_file(PRETRAINED / value))) or value


def hash_file(path: Path | str) -> str | None:
    """SHA-256 of a file; None where there is no such file."""
    with contextlib.suppress(OSError, ValueError), open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
    return None


def processor() -> str:
    """The name of this machine's processor."""
    return cpu_info().get("model name") or platform.processor() or "unknown"


def cpu_info() -> dict[str, str]:
    """What Linux says about the processor; empty on other systems."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        pairs = (line.partition(":") for line in lines)
        return {name.strip(): value.strip() for name, _, value in pairs}
    return {}
