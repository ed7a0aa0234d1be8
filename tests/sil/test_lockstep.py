"""The clock of simulated time that is loaded into Betaflight, without Betaflight."""

import os
import socket
import struct
import subprocess
from pathlib import Path

from quadjax.export.compiler import host
from quadjax.sil.betaflight_firmware import HOST, LOCKSTEP, PORTS

BOOT_US, STEP_US, STEPS = 3_000_000, 1000, 100


def test_the_clock_advances_by_a_step_between_two_states_also_where_answers_come_at_once(tmp_path):
    source, options = Path(__file__).with_name("answering.c"), ("-D_GNU_SOURCE", "-lpthread")
    program = host().build([source], tmp_path / "answering", options)
    library = tmp_path / "lockstep.so"
    host().build([LOCKSTEP], library, ("-shared", "-fPIC", "-ldl", "-lpthread"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind((HOST, 0))
        link.settimeout(10.0)
        preload = {"LD_PRELOAD": str(library), "QUADJAX_MOTORS": str(link.getsockname()[1])}
        process = subprocess.Popen([program], env=os.environ | preload)
        try:
            state, sticks, _ = struct.unpack(PORTS, link.recv(64))
            times = []
            for _ in range(STEPS):
                link.sendto(bytes(40), (HOST, sticks))
                link.sendto(bytes(144), (HOST, state))
                times.append(round(1e6 * struct.unpack("2d", link.recv(64))[0]))
        finally:
            process.kill()
            process.wait()
    assert times == [BOOT_US + STEP_US * number for number in range(STEPS)]
