"""Compilers for the processors of ``benchmarks.instructions``, and what is built with them."""

import dataclasses
import functools
import shutil
import sys
from collections.abc import Callable

from quadjax.export.compiler import Compiler, Skipped, has_module

ZIG = "-DBENCH_MATH=1 -fno-math-errno -O3 -std=c99 -fno-sanitize=all -Wl,--image-base=0x10000"
PAPARAZZI = "-mfloat-abi=softfp -mfpu=vfp -march=armv7-a -mtune=cortex-a8 -O3 -std=gnu99 -static"
# Betaflight's and INDIflight's flags for STM32F7 and H7.
FPU = {"cortex-m7": ("fp_armv8d16sp", "fpv5-sp-d16"), "cortex-m4": ("vfp4d16sp", "fpv4-sp-d16")}
# After the sources.
WITH_MATH = "-nostartfiles -lm -lc -lgcc -Wl,--defsym=_init=0,--defsym=_fini=0".split()


def zig(target: str, cpu: str) -> Compiler:
    """The compiler that pip installs; the target is arm or thumb, the CPU has its units."""
    if not has_module("ziglang"):
        raise Skipped("no ziglang; pip install 'quadjax[verify]'")
    flags = f"-target {target}-freestanding-eabihf -mcpu={cpu} {ZIG}".split()
    return Compiler("zig cc", (sys.executable, "-m", "ziglang", "cc"), tuple(flags))


def gcc(program: str, flags: str) -> Compiler:
    """A GCC on the path, for another processor."""
    if shutil.which(program) is None:
        raise Skipped(f"no {program} on this machine")
    return Compiler(program, (program,), tuple(flags.split()))


def zig_thumb(processor: str) -> Compiler:
    """The compiler that pip installs, for a Cortex-M7 or M4 with an FPU of single precision."""
    return zig("thumb", f"{processor.replace('-', '_')}+{FPU[processor][0]}")


def arm_none_eabi(processor: str) -> Compiler:
    """GCC for a Cortex-M7 or M4, as firmware is built with it."""
    cpu = f"-mthumb -mcpu={processor} -mfloat-abi=hard -mfpu={FPU[processor][1]}"
    return gcc("arm-none-eabi-gcc", f"{cpu} -fsingle-precision-constant -O2 -std=gnu99")


def bebop() -> Compiler:
    """GCC with the flags that Paparazzi builds the Bebop with."""
    return gcc("arm-linux-gnueabi-gcc", PAPARAZZI)


@dataclasses.dataclass(frozen=True)
class Build:
    """The C by one compiler for one processor, and the kernel that runs."""

    label: str
    make: Callable[[], Compiler]
    neon: bool = False
    options: tuple[str, ...] = ()

    @property
    def has_math(self) -> bool:
        """Whether the C library's functions are linked; without, a step is no measurement."""
        return "zig" not in self.label


BUILDS = {  # by target
    "cortex-a9": (
        Build("scalar, zig", functools.partial(zig, "arm", "cortex_a9-neon")),
        Build("NEON, zig", functools.partial(zig, "arm", "cortex_a9"), True),
        Build("scalar, gcc", bebop, options=("-DQJ_WITH_NEON=1",)),
        Build("NEON, gcc", bebop, True, ("-DQJ_WITH_NEON=1",)),
    ),
    **{
        processor: (
            Build("zig", functools.partial(zig_thumb, processor)),
            Build("gcc", functools.partial(arm_none_eabi, processor)),
        )
        for processor in FPU
    },
}
