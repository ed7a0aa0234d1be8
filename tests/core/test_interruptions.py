"""Ctrl-C: the first sets an event and says what happens, the second raises."""

import os
import signal

import pytest

from quadjax.core.interruptions import interruptions


def test_the_first_sets_an_event_and_the_second_raises(capfd):
    before = signal.getsignal(signal.SIGINT)
    with interruptions() as stop:
        assert not stop.is_set()
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(10)
        assert "Ctrl-C again ends without saving" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            stop.wait(10)
            signal.pause()
    assert signal.getsignal(signal.SIGINT) is before
