"""Compilers of this machine, and their flags."""

import dataclasses
import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from quadjax.export.verify.result import Failed, Skipped

WARNINGS = (
    "-Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wcast-align -Werror "
    # Paparazzi's own set, and a little more
    "-Wunused -Wcast-qual -Wpointer-arith -Wmissing-prototypes -Wmissing-declarations "
    "-Wstrict-prototypes -Wnested-externs -Wredundant-decls -Wswitch-default -Wundef "
    "-Wwrite-strings -Wformat-security -Wvla -Wdouble-promotion -Wfloat-equal"
).split()
BEBOP = (
    "-mfloat-abi=softfp -mfpu=vfp -march=armv7-a -mtune=cortex-a8 -O3 -std=gnu99 -static".split()
)
ZIG = (
    "-target arm-freestanding-eabihf -mcpu=cortex_a9 -O3 -std=c99 -nostdlib -fno-sanitize=all "
    "-Wl,--image-base=0x10000 -Wl,--no-gc-sections"
).split()
# Betaflight's and INDIflight's flags for STM32F7 and H7, and those of the Crazyflie's STM32F405.
FPU = {"Cortex-M7": ("fp_armv8d16sp", "fpv5-sp-d16"), "Cortex-M4": ("vfp4d16sp", "fpv4-sp-d16")}
FREESTANDING = "-nostdlib -nostartfiles -ffreestanding".split()


@dataclasses.dataclass(frozen=True)
class Compiler:
    """A compiler with the flags that make it build for one machine."""

    name: str
    command: tuple[str, ...]
    flags: tuple[str, ...]

    def build(self, sources: Sequence[Path], output: Path, extra: Sequence[str] = ()) -> Path:
        """Compile and link.

        Raises:
            Failed: with the first line of the compiler's output.
        """
        command = [*self.command, *self.flags, *extra, *map(str, sources), "-o", str(output)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            lines = [
                line for line in done.stderr.splitlines() if "error" in line or "warning" in line
            ]
            raise Failed(f"{self.name}: {(lines or done.stderr.splitlines() or ['failed'])[0]}")
        return output


def has_module(name: str) -> bool:
    """Whether a Python package is installed."""
    return importlib.util.find_spec(name) is not None


def need_program(name: str) -> str:
    """The path of a program, or ``Skipped``."""
    path = shutil.which(name)
    if path is None:
        raise Skipped(f"no {name} on this machine")
    return path


def host() -> Compiler:
    """The host's C compiler: cc, gcc, clang, or the one that pip installs."""
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return Compiler(name, (name,), ("-std=c99", "-O2"))
    if has_module("ziglang"):
        command = (sys.executable, "-m", "ziglang", "cc")
        return Compiler("zig cc", command, ("-std=c99", "-O2", "-fno-sanitize=all"))
    raise Skipped("no C compiler on this machine; pip install ziglang")


def zig_arm(neon: bool) -> Compiler:
    """The compiler that pip installs, for a Cortex-A9 without an operating system."""
    if not has_module("ziglang"):
        raise Skipped("no ziglang; pip install 'quadjax[verify]'")
    flags = ZIG if neon else [f.replace("cortex_a9", "cortex_a9-neon") for f in ZIG]
    command = (sys.executable, "-m", "ziglang", "cc")
    return Compiler("zig cc", command, tuple(flags))


def zig_thumb(processor: str) -> Compiler:
    """The compiler that pip installs, for a Cortex-M7 or M4 with an FPU of single precision."""
    flags = [flag.replace("arm-free", "thumb-free") for flag in zig_arm(neon=True).flags]
    cpu = f"{processor.lower().replace('-', '_')}+{FPU[processor][0]}"
    flags[flags.index("-mcpu=cortex_a9")] = f"-mcpu={cpu}"
    return dataclasses.replace(zig_arm(neon=True), flags=tuple(flags))


def arm_none_eabi(processor: str) -> Compiler:
    """GCC for a Cortex-M7 or M4, as firmware is built with it."""
    need_program("arm-none-eabi-gcc")
    cpu = f"-mthumb -mcpu={processor.lower()} -mfloat-abi=hard -mfpu={FPU[processor][1]}"
    flags = f"{cpu} -fsingle-precision-constant -O2 -std=gnu99".split()
    return Compiler("gcc arm-none-eabi", ("arm-none-eabi-gcc",), tuple(flags))


def bebop() -> Compiler:
    """GCC with the flags that Paparazzi builds the Bebop with."""
    need_program("arm-linux-gnueabi-gcc")
    return Compiler("gcc armel", ("arm-linux-gnueabi-gcc",), tuple(BEBOP))
