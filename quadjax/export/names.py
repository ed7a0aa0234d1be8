"""The names in an exported folder, and checks of names and folders that need no JAX."""

import math
import re
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.core.files import check_file
from quadjax.core.folders import check_kind, kind_of

KIND = "export"
POLICY_FILE, CONFIG_FILE, RESIDUAL_FILE = "policy.npz", "config.yaml", "residual.npz"
REPORT = "_report.json"
LONGEST_NAME = 31
SMALLEST, LARGEST = 2.0**-20, 2.0**20  # half-widths of the inputs' ranges
POWER_OF_TWO = "a power of two, 2^-20 to 2^20"
RESERVED = re.compile(r"(qj|quadjax|neural_network|nn_controller|controller_quadjax)(_|$)")
HEADERS = frozenset(  # of C, POSIX, firmware, all that the runtime includes, and names on Windows
    """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign
    stdarg stdatomic stdbit stdbool stdckdint stddef stdint stdio stdlib stdnoreturn string tgmath
    threads time uchar wchar wctype
    aio cpio dirent dlfcn fcntl fmtmsg fnmatch ftw glob grp iconv langinfo libgen libintl monetary
    mqueue ndbm netdb nl_types poll pthread pwd regex sched search semaphore spawn strings stropts
    syslog tar termios trace ulimit unistd utime utmpx wordexp alloca endian features getopt malloc
    memory values
    abi actuators autopilot board build_config common config debug drivers freertos generated led
    main motor paparazzi pinmux platform rc servo state std system types uart utils version
    arm_math arm_neon auxv cmsis_compiler cmsis_gcc core_cm4 core_cm7 firmware preflight_checks
    gps low_pass_filter stabilization stabilization_indi_simple sys_time telemetry
    aux con nul prn
    """.split()
)


def identifier(text: str) -> str:
    """Text as a lower-case C identifier."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_") or "policy"
    return name if name[0].isalpha() else f"policy_{name}"


def symbol_name(name: str | None, file: str) -> str:
    """The name of the header and of the policy in it: the requested one, or the policy file's.

    Raises:
        InputError: a name that is no identifier, or that of a header of C, of the runtime or of a
            firmware.
    """
    if name is None:
        stem = identifier(Path(file).stem)
        return (f"policy_{stem}" if _is_taken(stem) else stem)[:LONGEST_NAME]
    if identifier(name) != name or len(name) > LONGEST_NAME:
        raise InputError(
            f"--name {name!r}: expected a lower-case C identifier of at most {LONGEST_NAME} letters"
        )
    if _is_taken(name):
        raise InputError(
            f"--name {name!r}: files of the runtime, of C or of a firmware have such names; choose "
            f"another, such as policy_{name}"
        )
    return name


def _is_taken(name: str) -> bool:
    """Whether ``NAME.h`` may stand in the place of another header."""
    return bool(RESERVED.match(name)) or name in HEADERS


def is_range(size: float) -> bool:
    """Whether the half-width of an input's range is a power of two that the format allows."""
    return SMALLEST <= size <= LARGEST and math.frexp(size)[0] == 0.5


def check_new_folder(folder: Path, name: str, overwrite: bool) -> None:
    """Reject a folder with another export; without ``overwrite`` also with any export or files.

    Raises:
        InputError: such a folder; the message says what to do.
    """
    check_kind(folder, KIND)
    others = sorted(path.name for path in folder.glob("*")) if folder.is_dir() else []
    names = [file.removesuffix(REPORT) for file in others if file.endswith(REPORT)]
    another = [other for other in names if other != name]
    if another:
        raise InputError(
            f"{folder}: holds an export named {another[0]!r}; choose another folder (--output), or "
            "delete it"
        )
    if names and not overwrite:
        raise InputError(
            f"{folder} holds an export already: replace it (--overwrite) or choose another "
            "folder (--output)"
        )
    if others and not overwrite and kind_of(folder) is None:
        raise InputError(
            f"{folder} holds no export, but {others[0]}: choose another folder (--output), or "
            "write next to these files (--overwrite)"
        )


def report_of(folder: Path) -> Path:
    """The report in an exported folder.

    Raises:
        InputError: no such folder, or one that is no complete export.
    """
    if not folder.is_dir():
        fault = "is a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: {fault}, expected a folder of quadjax export")
    check_kind(folder, KIND)
    reports = sorted(folder.glob(f"*{REPORT}"))
    if len(reports) != 1:
        allowed = f"expected one *{REPORT}, as in a folder of quadjax export"
        raise InputError(f"{folder}: {allowed}, found {len(reports)}")
    for name in (POLICY_FILE, CONFIG_FILE):
        check_file(folder / name)
    return reports[0]
