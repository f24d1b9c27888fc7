"""Saves the memory: at once where something rests on it, from a thread where nothing does, so that a slow disk stops no robot."""

from __future__ import annotations

import threading

from s2r_runtime.daemon.persistence import StateFolder
from s2r_runtime.messages import Memory


class Saver:
    """The newest memory wins: what the thread still holds is discarded when a later one is saved at once."""

    def __init__(self, folder: StateFolder) -> None:
        self._folder = folder
        self._newest: Memory | None = None
        self._trouble = ""
        self._ending = False
        self._wake = threading.Condition()
        self._writing = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="saver", daemon=True)
        self._thread.start()

    def now(self, memory: Memory) -> None:
        """Durable when this returns. Raises OSError if the disk does not take it."""
        with self._writing:
            with self._wake:
                self._newest = None
            self._folder.save(memory)
            self._trouble = ""

    def soon(self, memory: Memory) -> None:
        """Returns at once."""
        with self._wake:
            self._newest = memory
            self._wake.notify()

    @property
    def trouble(self) -> str:
        """Why the last memory was not saved, or empty."""
        return self._trouble

    def close(self) -> None:
        """Saves what it still holds and ends; may be called twice."""
        with self._wake:
            self._ending = True
            self._wake.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._newest is not None or self._ending)
                if self._newest is None:
                    return
            with self._writing:
                with self._wake:
                    memory, self._newest = self._newest, None
                if memory is None:
                    continue
                try:
                    self._folder.save(memory)
                    self._trouble = ""
                except OSError as error:
                    self._trouble = error.strerror or str(error)
