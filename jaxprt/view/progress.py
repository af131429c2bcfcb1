"""What a session prepares, for the page, and for the program that waits for it."""

import os
import sys
import threading
from typing import Any

_LOWER = 10  # by which the priority of a thread is reduced


class EndedError(Exception):
    """Nobody waits for the work any more."""


class Progress:
    """What is being done and how far it is. It is safe to share between threads."""

    def __init__(self):
        """Starts with nothing done."""
        self._changed = threading.Condition()
        self._stage: str = "starting"
        self._share: float | None = None
        self._error: BaseException | None = None
        self._prepared = self._finished = self._told = False

    def report(self, stage: str, share: float | None) -> None:
        """Sets what is being done, and which share of it is done, from 0 to 1; None if nobody knows.

        When all of it is done, what follows until the next report makes the scene from it.
        """
        with self._changed:
            done = share is not None and share >= 1
            self._stage, self._share = ("preparing the scene", None) if done else (stage, share)

    def prepared(self) -> None:
        """The scene is complete. What follows makes it only faster."""
        self._set("_prepared", True)

    def fail(self, error: BaseException) -> None:
        """The scene cannot be computed."""
        self._set("_error", error)

    def finish(self) -> None:
        """Nothing more will be done."""
        self._set("_finished", True)

    def _set(self, name: str, value: Any) -> None:
        with self._changed:
            setattr(self, name, value)
            self._changed.notify_all()

    def wait(self, *, patience: float = 0.0) -> None:
        """Waits until the scene is complete.

        Args:
            patience: If there is an error, most seconds to wait until a page was told of it.

        Raises:
            BaseException: The error by which the computation of the scene has ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._prepared or self._finished)
            if self._error is not None:
                self._changed.wait_for(lambda: self._told, patience)
                raise self._error

    @property
    def finished(self) -> bool:
        """Whether nothing more will be done."""
        return self._finished

    def content(self) -> dict[str, Any]:
        """The message to the page."""
        with self._changed:
            content = {"kind": "progress", "stage": self._stage, "fraction": self._share, "finished": self._finished}
            if self._error is None or not self._finished:
                return content
            self._told = True
            self._changed.notify_all()
            return content | {"error": str(self._error) or type(self._error).__name__}


def yield_cores() -> None:
    """Lowers the priority of this thread, and of threads that it starts, so that answers come first."""
    if sys.platform == "linux":  # the only system with priorities of threads
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LOWER)
