"""The faults of ``tests/mutations.yaml`` follow the code."""

from tests.mutations import FAULTS, ROOT


def test_every_fault_can_be_planted():
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 40
    texts = {fault.file: (ROOT / "quadjax" / fault.file).read_text("utf-8") for fault in FAULTS}
    counts = {fault.name: texts[fault.file].count(fault.old) for fault in FAULTS}
    assert {name for name, count in counts.items() if count != 1} == set()
    assert [fault.tests for fault in FAULTS if not (ROOT / fault.tests).is_file()] == []
