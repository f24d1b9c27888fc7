"""Code of others, a model or an effect, runs in the process of the verb that needs it, and can end that without a word: `os._exit(0)`.

So the verb runs in a process of its own, and this one waits for its end. A verb that ends with exit code 0 and did not come to its own end
has no answer.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

from s2r_runtime.child import die_with_parent
from s2r_runtime.cli import output
from s2r_runtime.errors import PluginError

VERBS = frozenset({"gap", "trace", "verify", "certify", "synthesize", "audit", "trials", "report", "topics"})
"""Those that compute with models of others here. The daemon has processes of its own for them."""
_PASSED_ON = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


class EndedBySignal(SystemExit):
    """What a verb's own handler of a signal raises: main takes any other SystemExit for one of others' code."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)


def run(verb: Callable[[], int]) -> int:
    """verb(), in a process of its own; returns (or raises) there, and ends this process with the same exit code or signal."""
    output.stand_in_for_closed_streams()  # or the pipe would take their place
    reading, writing = os.pipe()
    waited = {*_PASSED_ON, signal.SIGCHLD}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, waited)
    waiting, child = os.getpid(), os.fork()
    if child == 0:
        os.close(reading)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        die_with_parent(waiting)
        try:
            return verb()
        finally:
            output.flush()
            os.write(writing, b"k")
    os.close(writing)
    os._exit(_waited_for(child, reading, waited))


def _waited_for(child: int, reading: int, waited: set[signal.Signals]) -> int:
    """The exit code for that of the child."""
    while True:
        told = signal.sigwaitinfo(waited)
        if told.si_signo != signal.SIGCHLD:
            if told.si_code <= 0:  # of a process; what the terminal sends, the child gets itself
                os.kill(child, told.si_signo)
            continue
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        if -code != signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, waited)
        os.kill(os.getpid(), -code)
        return 128 - code
    if code == 0 and not _came_to_its_end(reading):
        error = PluginError("code of a model or an effect ended the program (os._exit?) before there was an answer")
        output.fail(str(error), error.exit_code, as_json=False)
        output.flush()
        return error.exit_code
    return code


def _came_to_its_end(reading: int) -> bool:
    os.set_blocking(reading, False)  # a process that it left behind may still have the other end
    try:
        return bool(os.read(reading, 1))
    except BlockingIOError:
        return False
