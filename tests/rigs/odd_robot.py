"""As loop_robot.py, with a transport that misbehaves as the file `odd` in its folder says: CALL HOW. It is asked at every call.

HOW: hang, stubborn (a hang that can't be interrupted), exit (SystemExit), or a Python expression whose value the call gives instead.
"""

from __future__ import annotations

import contextlib
import time
from typing import Any

import loop_robot

from s2r_runtime.messages import Command, Frame, LinkChanged, Observation, OverrideChanged

KNOWN = {"Frame": Frame, "Observation": Observation, "Command": Command, "LinkChanged": LinkChanged, "OverrideChanged": OverrideChanged}


class OddTransport(loop_robot.LoopTransport):
    def _odd(self, call: str, honest: Any, *args: Any) -> Any:
        try:
            wanted, _, how = (self._folder / "odd").read_text().partition(" ")
        except FileNotFoundError:
            wanted, how = "", ""
        if wanted != call:
            return honest(*args)
        if how == "hang":
            time.sleep(3600.0)
        while how == "stubborn":
            with contextlib.suppress(BaseException):
                time.sleep(3600.0)
        if how == "exit":
            raise SystemExit(3)
        return eval(how, dict(KNOWN))  # noqa: S307 - this test wrote it

    def open(self) -> None:
        return self._odd("open", super().open)

    def fileno(self) -> int:
        return self._odd("fileno", super().fileno)

    def receive(self) -> Any:
        return self._odd("receive", super().receive)

    def decode(self, frame: Frame) -> Any:
        return self._odd("decode", super().decode, frame)

    def poll(self, now_ns: int) -> Any:
        return self._odd("poll", super().poll, now_ns)

    def encode(self, command: Command) -> Any:
        return self._odd("encode", super().encode, command)

    def send(self, frame: Frame) -> None:
        return self._odd("send", super().send, frame)

    def counters(self) -> Any:
        return self._odd("counters", super().counters)

    def lines(self) -> Any:
        return self._odd("lines", list)


loop_robot.LoopTransport = OddTransport  # type: ignore[misc]

if __name__ == "__main__":
    raise SystemExit(loop_robot.main())
