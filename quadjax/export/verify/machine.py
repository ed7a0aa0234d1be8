"""An emulated Cortex-A9, M7 or M4 that runs compiled functions and counts their instructions.

Needs the packages of the ``verify`` extra: ``unicorn`` and ``pyelftools``.
"""

from pathlib import Path
from typing import Any

import numpy as np
from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection
from unicorn import UC_ARCH_ARM, UC_HOOK_BLOCK, UC_MODE_ARM, UC_MODE_MCLASS, UC_MODE_THUMB, Uc
from unicorn.arm_const import (
    UC_ARM_REG_C1_C0_2,
    UC_ARM_REG_FPEXC,
    UC_ARM_REG_LR,
    UC_ARM_REG_R0,
    UC_ARM_REG_R1,
    UC_ARM_REG_R2,
    UC_ARM_REG_R3,
    UC_ARM_REG_SP,
    UC_CPU_ARM_CORTEX_A9,
    UC_CPU_ARM_CORTEX_M4,
    UC_CPU_ARM_CORTEX_M7,
)

from quadjax.core.interruptions import uninterrupted

PAGE = 4096
STACK_TOP, STACK_SIZE = 0x7000_0000, 1 << 20
HEAP, HEAP_SIZE = 0x4000_0000, 1 << 28
RETURN = 0x3000_0000  # an address that holds no code: the end of a call
PAINT = 0xA5
ARGUMENTS = (UC_ARM_REG_R0, UC_ARM_REG_R1, UC_ARM_REG_R2, UC_ARM_REG_R3)
LONG = 0x1D  # Thumb: first bits of an instruction of four bytes
APPLICATION, MICROCONTROLLER = UC_MODE_ARM, UC_MODE_THUMB | UC_MODE_MCLASS
MODELS = {
    "Cortex-A9": (APPLICATION, UC_CPU_ARM_CORTEX_A9),
    "Cortex-M7": (MICROCONTROLLER, UC_CPU_ARM_CORTEX_M7),
    "Cortex-M4": (MICROCONTROLLER, UC_CPU_ARM_CORTEX_M4),
}


class Machine:
    """A processor with its FPU and NEON switched on, and one ELF file in its memory."""

    def __init__(self, path: Path, processor: str = "Cortex-A9") -> None:
        """Load an ELF executable, whose symbols become callable; the processor is of ``MODELS``."""
        mode, model = MODELS[processor]
        self._cpu: Any = Uc(UC_ARCH_ARM, mode)  # of a subclass that its package does not declare
        self._cpu.ctl_set_cpu_model(model)
        self._thumb = int(mode == MICROCONTROLLER)  # bit 0 of the address of a function
        self.symbols: dict[str, int] = {}
        self._load(path)
        self._cpu.mem_map(STACK_TOP - STACK_SIZE, STACK_SIZE)
        self._cpu.mem_map(HEAP, HEAP_SIZE)
        self._cpu.mem_map(RETURN, PAGE)
        if mode == APPLICATION:
            access = self._cpu.reg_read(UC_ARM_REG_C1_C0_2) | (0xF << 20)
            self._cpu.reg_write(UC_ARM_REG_C1_C0_2, access)
            self._cpu.reg_write(UC_ARM_REG_FPEXC, 0x40000000)
        self._free = HEAP
        self._signals: list[int] = []  # that have come during a call
        self._blocks: dict[tuple[int, int], int] = {}  # instructions by address and size

    def _load(self, path: Path) -> None:
        with open(path, "rb") as stream:
            elf = ELFFile(stream)
            pages = set()
            segments = [s for s in elf.iter_segments() if s["p_type"] == "PT_LOAD"]
            for segment in segments:
                start = segment["p_vaddr"] // PAGE
                end = (segment["p_vaddr"] + segment["p_memsz"] + PAGE - 1) // PAGE
                pages |= set(range(start, end))
            for page in sorted(pages):
                self._cpu.mem_map(page * PAGE, PAGE)
            for segment in segments:
                self._cpu.mem_write(segment["p_vaddr"], segment.data())
            table = elf.get_section_by_name(".symtab")
            if isinstance(table, SymbolTableSection):
                self.symbols |= {s.name: s["st_value"] for s in table.iter_symbols()}

    def place(self, values: np.ndarray) -> int:
        """Copy an array into the machine; returns its address, a multiple of 16."""
        address = self.reserve(values.nbytes)
        self._cpu.mem_write(address, np.ascontiguousarray(values).tobytes())
        return address

    def reserve(self, size: int) -> int:
        """The address of ``size`` bytes."""
        address = self._free
        self._free += -(-max(size, 1) // 64) * 64
        return address

    def read(self, address: int, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
        """Copy an array out of the machine."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        return np.frombuffer(self._cpu.mem_read(address, size), dtype).reshape(shape).copy()

    def call(self, name: str, *arguments: int) -> int:
        """Call a function of integer or pointer arguments; returns r0."""
        beyond = np.array(arguments[len(ARGUMENTS) :], np.uint32)  # these go on the stack
        self._cpu.reg_write(UC_ARM_REG_SP, STACK_TOP - 64)
        self._cpu.mem_write(STACK_TOP - 64, beyond.tobytes())
        self._cpu.reg_write(UC_ARM_REG_LR, RETURN | self._thumb)
        for register, value in zip(ARGUMENTS, arguments, strict=False):
            self._cpu.reg_write(register, value)
        with uninterrupted() as self._signals:  # an exception in a hook would be lost
            self._cpu.emu_start(self.symbols[name], RETURN)
        return self._cpu.reg_read(UC_ARM_REG_R0)

    def _instructions(self, address: int, size: int) -> int:
        """How many instructions a block of code has."""
        if not self._thumb:
            return size // 4
        halves = np.frombuffer(self._cpu.mem_read(address, size), "<u2")
        count = position = 0
        while position < len(halves):
            position += 2 if halves[position] >> 11 >= LONG else 1
            count += 1
        return count

    def count(self, name: str, *arguments: int) -> tuple[int, int]:
        """Instructions and bytes of stack that one call takes.

        An instruction whose condition is false counts, as the processor takes a cycle for it.
        """
        counted = 0

        def block(_cpu: Uc, address: int, size: int, _data: object) -> None:
            """Count a block, which begins and ends with a jump: all of it is executed."""
            nonlocal counted
            if (address, size) not in self._blocks:
                self._blocks[address, size] = self._instructions(address, size)
            counted += self._blocks[address, size]
            if self._signals:
                self._cpu.emu_stop()

        bottom = STACK_TOP - STACK_SIZE
        self._cpu.mem_write(bottom, bytes([PAINT]) * STACK_SIZE)
        self._cpu.ctl_flush_tb()  # code that was translated without the hook would not be counted
        hook = self._cpu.hook_add(UC_HOOK_BLOCK, block)
        self.call(name, *arguments)
        self._cpu.hook_del(hook)
        self._cpu.ctl_flush_tb()
        painted = np.frombuffer(self._cpu.mem_read(bottom, STACK_SIZE - 64), np.uint8)
        used = np.flatnonzero(painted != PAINT)
        return counted, 0 if not used.size else len(painted) - int(used[0])
