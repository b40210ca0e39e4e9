"""Messages that compiled libraries print themselves are discarded, and standard error works afterwards."""

import os
import threading

import pytest

from dhcal_pin.native_output import discard_native_messages


def test_messages_in_the_block_are_discarded(capfd):
    os.write(2, b"before\n")

    def fail():
        with discard_native_messages():
            os.write(2, b"inside\n")
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "before\nafter\n"


def test_threads_restore_the_stream(capfd):
    """Without a lock, a thread takes the discarded stream of another one for the original."""
    descriptors = len(os.listdir("/dev/fd"))

    def work():
        for _ in range(200):
            with discard_native_messages():
                os.write(2, b"inside\n")

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"
    assert len(os.listdir("/dev/fd")) == descriptors
