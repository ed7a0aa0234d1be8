"""An emulated Cortex-A9, M7 or M4 for ``benchmarks.instructions``: it runs functions and counts."""

from pathlib import Path

import numpy as np
from elftools.elf.elffile import ELFFile
from unicorn import UC_ARCH_ARM, UC_HOOK_BLOCK, UC_MODE_ARM, UC_MODE_MCLASS, UC_MODE_THUMB, Uc
from unicorn import arm_const as arm

STACK_TOP, STACK_SIZE = 0x7000_0000, 1 << 20
BOTTOM, HEAP = STACK_TOP - STACK_SIZE, 0x4000_0000
RETURN = 0x3000_0000  # an address that holds no code: the end of a call
MEMORY = {0: 1 << 24, BOTTOM: STACK_SIZE, HEAP: 1 << 28, RETURN: 4096}  # the program is at 0
PAINT = 0xA5
ARGUMENTS = (arm.UC_ARM_REG_R0, arm.UC_ARM_REG_R1, arm.UC_ARM_REG_R2, arm.UC_ARM_REG_R3)
LONG = 0x1D  # Thumb: first bits of an instruction of two halves
APPLICATION, MICROCONTROLLER = UC_MODE_ARM, UC_MODE_THUMB | UC_MODE_MCLASS
MODELS = {
    "cortex-a9": (APPLICATION, arm.UC_CPU_ARM_CORTEX_A9),
    "cortex-m7": (MICROCONTROLLER, arm.UC_CPU_ARM_CORTEX_M7),
    "cortex-m4": (MICROCONTROLLER, arm.UC_CPU_ARM_CORTEX_M4),
}


class Machine:
    """A processor with its FPU and NEON switched on, and one ELF file in its memory."""

    def __init__(self, elf: Path, processor: str) -> None:
        """Load an ELF executable, whose symbols become callable; the processor is of ``MODELS``."""
        mode, model = MODELS[processor]
        self._cpu = Uc(UC_ARCH_ARM, mode)
        self._cpu.ctl_set_cpu_model(model)
        self._thumb = int(mode == MICROCONTROLLER)  # bit 0 of the address of a function
        for start, size in MEMORY.items():
            self._cpu.mem_map(start, size)
        self._load(elf)
        if mode == APPLICATION:
            access = self._cpu.reg_read(arm.UC_ARM_REG_C1_C0_2) | (0xF << 20)
            self._cpu.reg_write(arm.UC_ARM_REG_C1_C0_2, access)
            self._cpu.reg_write(arm.UC_ARM_REG_FPEXC, 0x40000000)
        self._free = HEAP
        self._blocks = {}  # instructions by address and size

    def _load(self, path: Path) -> None:
        with open(path, "rb") as stream:
            elf = ELFFile(stream)
            for segment in elf.iter_segments("PT_LOAD"):
                self._cpu.mem_write(segment["p_vaddr"], segment.data())
            table = elf.get_section_by_name(".symtab")
            self._symbols = {s.name: s["st_value"] for s in table.iter_symbols()}

    def place(self, values: np.ndarray) -> int:
        """Copy an array into the machine; returns its address."""
        address = self.reserve(values.nbytes)
        self._cpu.mem_write(address, np.ascontiguousarray(values).tobytes())
        return address

    def reserve(self, size: int) -> int:
        """The address of ``size`` bytes, a multiple of 64."""
        address = self._free
        self._free += -(-max(size, 1) // 64) * 64
        return address

    def read(self, address: int, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
        """Copy an array out of the machine."""
        out = np.zeros(shape, dtype)
        out.data.cast("B")[:] = self._cpu.mem_read(address, out.nbytes)
        return out

    def call(self, name: str, *arguments: int) -> int:
        """Call a function of integer or pointer arguments; returns r0."""
        beyond = np.array(arguments[len(ARGUMENTS) :], np.uint32)  # these go on the stack
        self._cpu.reg_write(arm.UC_ARM_REG_SP, STACK_TOP - 64)
        self._cpu.mem_write(STACK_TOP - 64, beyond.tobytes())
        self._cpu.reg_write(arm.UC_ARM_REG_LR, RETURN | self._thumb)
        for register, value in zip(ARGUMENTS, arguments):
            self._cpu.reg_write(register, value)
        self._cpu.emu_start(self._symbols[name], RETURN)
        return self._cpu.reg_read(arm.UC_ARM_REG_R0)

    def _instructions(self, address: int, size: int) -> int:
        """How many instructions a block of code has."""
        if not self._thumb:
            return size // 4
        halves = iter(np.frombuffer(self._cpu.mem_read(address, size), "<u2"))
        return sum(1 for half in halves if half >> 11 < LONG or next(halves) is not None)

    def count(self, name: str, *arguments: int) -> tuple[int, int]:
        """Instructions and bytes of stack that one call takes.

        An instruction whose condition is false counts, as the processor takes a cycle for it.
        """
        counted = 0

        def block(_cpu, address, size, _data) -> None:  # all of it is executed
            nonlocal counted
            if (address, size) not in self._blocks:
                self._blocks[address, size] = self._instructions(address, size)
            counted += self._blocks[address, size]

        self._cpu.mem_write(BOTTOM, bytes([PAINT]) * STACK_SIZE)
        self._cpu.ctl_flush_tb()  # code that was translated without the hook would not be counted
        hook = self._cpu.hook_add(UC_HOOK_BLOCK, block)
        self.call(name, *arguments)
        self._cpu.hook_del(hook)
        self._cpu.ctl_flush_tb()
        painted = np.frombuffer(self._cpu.mem_read(BOTTOM, STACK_SIZE - 64), np.uint8)
        used = np.flatnonzero(painted != PAINT)
        return counted, 0 if not used.size else len(painted) - int(used[0])
