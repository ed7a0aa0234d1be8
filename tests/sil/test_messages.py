"""Messages: what is rejected, the C header, and the faults of the link."""

import subprocess

import numpy as np
import pytest

from quadjax.export.verify.toolchain import host
from quadjax.sil.faults import Channel, Faults
from quadjax.sil.message import DTYPES, HEADER, Kind, MessageError, new, pack, unpack
from quadjax.sil.source import header_text


def state(sequence=0):
    message = new(Kind.STATE, 2, sequence, 0.25)
    message["position_ned_m"] = [1.0, 2.0, 3.0]
    message["attitude_rpy_rad"] = [0.0, np.pi, -np.pi]
    return message


def test_a_message_comes_back_as_it_was_sent():
    found = unpack(pack(state(7)))
    assert (found["run"], found["sequence"], found["time_s"]) == (2, 7, 0.25)
    np.testing.assert_array_equal(found["position_ned_m"], [1.0, 2.0, 3.0])
    assert found["length"] == DTYPES[Kind.STATE].itemsize


def test_every_flipped_bit_and_every_other_length_is_rejected():
    data = pack(new(Kind.COMMAND))
    with pytest.raises(MessageError, match="version 2, allowed: 1"):
        unpack(data[:4] + b"\2" + data[5:])
    for bit in range(8 * len(data)):
        flipped = (int.from_bytes(data, "big") ^ 1 << bit).to_bytes(len(data), "big")
        with pytest.raises(MessageError):
            unpack(flipped)
    for other in (*(data[:length] for length in range(len(data))), data + b"\0"):
        with pytest.raises(MessageError):
            unpack(other)


def test_the_c_header_has_the_fields_where_the_messages_have_them(tmp_path):
    (tmp_path / "message.h").write_text(header_text())
    lines, expected = [], []
    structs = {"sil_header": HEADER} | {
        f"sil_{kind.name.lower()}": DTYPES[kind] for kind in Kind if kind != Kind.END
    }
    for struct, dtype in structs.items():
        own = [name for name in dtype.names if struct == "sil_header" or name not in HEADER.names]
        lines += [f'printf("%d ", (int)offsetof({struct}, {name}));' for name in own]
        expected += [dtype.fields[name][1] for name in own]
    text = '#include <stddef.h>\n#include <stdio.h>\n#include "message.h"\n'
    (tmp_path / "main.c").write_text(text + "int main(void) {" + "\n".join(lines) + "return 0;}")
    program = host().build([tmp_path / "main.c"], tmp_path / "main", [f"-I{tmp_path}"])
    done = subprocess.run([str(program)], capture_output=True, text=True, check=True)
    assert [int(word) for word in done.stdout.split()] == expected


def test_faults_are_drawn_from_the_seed_and_counted():
    def sent(seed):
        channel = Channel(Faults(drop=0.3, late=0.3, delay=0.02, damage=0.2), seed, 0)
        arrived = []
        for step in range(500):
            channel.push(state(step), 0.01 * step)
            arrived += [(step, s.sequence, s.intact) for s in channel.due(0.01 * step)]
        return arrived, channel.counts

    (first, counts), (again, _), (other, _) = sent(1), sent(1), sent(2)
    assert first == again != other
    assert len(first) + counts["dropped"] >= counts["sent"] - 2
    assert {step - sequence for step, sequence, _ in first} == {0, 2}
    assert sum(not intact for _, _, intact in first) >= counts["damaged"] - 2
    assert 100 < counts["dropped"] < 200 and counts["late"] > 60


def test_wrong_units_and_nan_change_the_states_alone():
    faults = Faults(nan={"position": 1.0}, units=("attitude=deg",))
    channel = Channel(faults, 0, 0)
    original = state()
    channel.push(original, 0.0)
    found = unpack(channel.due(0.0)[0].data)
    np.testing.assert_allclose(found["attitude_rpy_rad"], [0.0, 180.0, -180.0], rtol=1e-6)
    assert np.isnan(found["position_ned_m"]).sum() == 1
    assert np.isfinite(original["position_ned_m"]).all() and faults and not Faults()
    channel.push(new(Kind.COMMAND), 0.0)
    assert np.isfinite(unpack(channel.due(0.0)[0].data)["command"]).all()
