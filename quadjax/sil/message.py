"""The messages between the simulated drone and an autopilot: format ``quadjax-sil/1``.

A message is one UDP datagram: a header and a payload of fixed size, little-endian, without padding.
A name ends with its unit. World north-east-down, body forward-right-down. Motors and rotors in the
order front-left, front-right, rear-right, rear-left.
"""

import enum
import math
import zlib

import numpy as np

MAGIC, VERSION = b"QSIL", 1
CHECKED = 16  # bytes before those that the checksum covers
RPM_PER_RAD_S = 30.0 / math.pi


class Kind(enum.IntEnum):
    """Kinds of messages."""

    HELLO = 1  # of the autopilot, once, before the first state
    STATE = 2  # of the drone, at every control step
    COMMAND = 3  # of the autopilot, for every state
    END = 4  # of the drone after the last state, or of an autopilot that leaves


class CommandKind(enum.IntEnum):
    """What the four numbers of a command are."""

    ROTOR_SPEEDS_RAD_S = 1
    RATES_RAD_S_AND_THRUST_M_S2 = 2
    MOTORS_0_TO_1 = 3


# Name, number type, count, and what it is. C and the documentation follow from these tables.
HEADER_FIELDS = (
    ("magic", "S1", 4, "the letters QSIL"),
    ("version", "<u2", 1, "of the format: 1"),
    ("kind", "<u2", 1, "1 hello, 2 state, 3 command, 4 end"),
    ("length", "<u4", 1, "bytes of the whole message"),
    ("crc32", "<u4", 1, "CRC-32 (as zlib's) of all bytes after this field"),
    ("run", "<u4", 1, "number of the race, from 0; a command has that of its state"),
    ("sequence", "<u4", 1, "control step of the race, from 0; a command has that of its state"),
    ("time_s", "<f8", 1, "since the start of the race; a command has that of its state"),
)
STATE_FIELDS = (
    ("position_ned_m", "<f4", 3, "estimated position, world"),
    ("velocity_ned_m_s", "<f4", 3, "estimated velocity, world"),
    ("velocity_frd_m_s", "<f4", 3, "the same, body"),
    ("attitude_rpy_rad", "<f4", 3, "estimated roll, pitch, yaw (yaw first, then pitch, then roll)"),
    ("quaternion_wxyz", "<f4", 4, "the same, body to world, of length one"),
    ("rates_frd_rad_s", "<f4", 3, "estimated p, q, r"),
    ("rotor_speed_rad_s", "<f4", 4, "measured; 0 for a drone without rotors in its model"),
    ("thrust_m_s2", "<f4", 1, "specific thrust of the inner loop; 0 without one"),
    ("gyro_frd_rad_s", "<f4", 3, "measured, less the estimated bias"),
    ("specific_force_frd_m_s2", "<f4", 3, "measured, less the estimated bias"),
    ("moment_frd_n_m", "<f4", 3, "estimated external moment; 0 without an estimator"),
    ("force_frd_m_s2", "<f4", 3, "estimated external specific force; 0 without an estimator"),
    ("gate_position_ned_m", "<f4", 3, "center of the gate to pass next"),
    ("gate_yaw_rad", "<f4", 1, "its direction of flight"),
    ("target_gate", "<u4", 1, "its number, by the rules of the race"),
    ("lock_step", "<u4", 1, "1: the drone waits for the command of this state; 0: real time"),
)
HELLO_FIELDS = (
    ("command_kind", "<u4", 1, "what the autopilot commands, see below"),
    ("self_test_mismatches", "<u4", 1, "of its self-test; a flight needs 0"),
)
COMMAND_FIELDS = (
    ("command_kind", "<u4", 1, "as in the hello"),
    ("command", "<f4", 4, "in the unit of its kind"),
    ("target_gate", "<u4", 1, "the autopilot's own; for the result only"),
    ("rejected_messages", "<u4", 1, "that the autopilot rejected since it started"),
    ("nan_steps", "<u4", 1, "steps of this race so far with an input that was NaN"),
    ("clipped_steps", "<u4", 1, "likewise, with an input outside its range"),
    ("outside_steps", "<u4", 1, "likewise, with an observation outside its range"),
)
Fields = tuple[tuple[str, str, int, str], ...]
PAYLOADS: dict[Kind, Fields] = {
    Kind.HELLO: HELLO_FIELDS,
    Kind.STATE: STATE_FIELDS,
    Kind.COMMAND: COMMAND_FIELDS,
    Kind.END: (),
}


def _dtype(fields: Fields) -> np.dtype:
    return np.dtype(
        [
            (name, "S4") if kind == "S1" else (name, kind, (count,)) if count > 1 else (name, kind)
            for name, kind, count, _ in fields
        ]
    )


HEADER = _dtype(HEADER_FIELDS)
DTYPES = {kind: _dtype(HEADER_FIELDS + fields) for kind, fields in PAYLOADS.items()}
LARGEST = max(dtype.itemsize for dtype in DTYPES.values())


class MessageError(ValueError):
    """A message that is rejected; the text is the reason."""


def new(kind: Kind, run: int = 0, sequence: int = 0, time_s: float = 0.0) -> np.ndarray:
    """A message with a payload of zeros, as a structured array () of ``DTYPES[kind]``."""
    message = np.zeros((), DTYPES[kind])
    message["magic"], message["version"], message["kind"] = MAGIC, VERSION, kind
    message["run"], message["sequence"], message["time_s"] = run, sequence, time_s
    return message


def pack(message: np.ndarray) -> bytes:
    """The bytes of a message, with its length and checksum."""
    message = message.copy()
    message["length"] = message.dtype.itemsize
    message["crc32"] = zlib.crc32(message.tobytes()[CHECKED:])
    return message.tobytes()


def unpack(data: bytes) -> np.ndarray:
    """A message, as ``new`` returns it.

    Raises:
        MessageError: another magic, version, kind, length or checksum.
    """
    if len(data) < HEADER.itemsize or data[:4] != MAGIC:
        raise MessageError("no message of this format")
    header = np.frombuffer(data[: HEADER.itemsize], HEADER)[0]
    if header["version"] != VERSION:
        raise MessageError(f"version {header['version']}, allowed: {VERSION}")
    if header["kind"] not in list(Kind):
        raise MessageError("unknown kind")
    dtype = DTYPES[Kind(header["kind"])]
    if not len(data) == header["length"] == dtype.itemsize:
        raise MessageError("wrong length")
    if zlib.crc32(data[CHECKED:]) != header["crc32"]:
        raise MessageError("wrong checksum")
    return np.frombuffer(data, dtype)[0]
