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
BEBOP = "-mfloat-abi=softfp -mfpu=vfp -march=armv7-a -mtune=cortex-a8 -O3 -std=gnu99 -static"
ZIG = (
    "-O3 -std=c99 -nostdlib -fno-sanitize=all -Wl,--image-base=0x10000 -Wl,--no-gc-sections"
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
        files = [*map(str, sources), "-o", str(output)]
        command = [*self.command, *self.flags, *files, *extra]  # a library follows its users
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            words = ("error:", "warning", "undefined")
            lines = [line for line in done.stderr.splitlines() if any(w in line for w in words)]
            raise Failed(f"{self.name}: {(lines or done.stderr.splitlines() or ['failed'])[0]}")
        return output


def has_module(name: str) -> bool:
    """Whether a Python package is installed."""
    return importlib.util.find_spec(name) is not None


def host() -> Compiler:
    """The host's C compiler: cc, gcc, clang, or the one that pip installs."""
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return Compiler(name, (name,), ("-std=c99", "-O2"))
    if has_module("ziglang"):
        command = (sys.executable, "-m", "ziglang", "cc")
        return Compiler("zig cc", command, ("-std=c99", "-O2", "-fno-sanitize=all"))
    raise Skipped("no C compiler on this machine; pip install ziglang")


def zig(target: str, cpu: str) -> Compiler:
    """The compiler that pip installs, for a processor without an operating system.

    The target is arm or thumb, the CPU has its units.
    """
    if not has_module("ziglang"):
        raise Skipped("no ziglang; pip install 'quadjax[verify]'")
    flags = (f"-target {target}-freestanding-eabihf -mcpu={cpu}".split(), ZIG)
    return Compiler("zig cc", (sys.executable, "-m", "ziglang", "cc"), tuple(sum(flags, [])))


def zig_arm(neon: bool) -> Compiler:
    """The compiler that pip installs, for a Cortex-A9."""
    return zig("arm", "cortex_a9" if neon else "cortex_a9-neon")


def zig_thumb(processor: str) -> Compiler:
    """The compiler that pip installs, for a Cortex-M7 or M4 with an FPU of single precision."""
    return zig("thumb", f"{processor.lower().replace('-', '_')}+{FPU[processor][0]}")


def gcc(name: str, program: str, flags: str) -> Compiler:
    """A GCC on the path, for another processor."""
    if shutil.which(program) is None:
        raise Skipped(f"no {program} on this machine")
    return Compiler(name, (program,), tuple(flags.split()))


def arm_none_eabi(processor: str) -> Compiler:
    """GCC for a Cortex-M7 or M4, as firmware is built with it."""
    cpu = f"-mthumb -mcpu={processor.lower()} -mfloat-abi=hard -mfpu={FPU[processor][1]}"
    flags = f"{cpu} -fsingle-precision-constant -O2 -std=gnu99"
    return gcc("gcc arm-none-eabi", "arm-none-eabi-gcc", flags)


def bebop() -> Compiler:
    """GCC with the flags that Paparazzi builds the Bebop with."""
    return gcc("gcc armel", "arm-linux-gnueabi-gcc", BEBOP)
