"""What a session prepares, for the page, and for the program that waits for it."""

import threading
from collections.abc import Sequence

from jaxprt.files.inputs import JsonObject

COMPILING = "compiling programs for changes"  # the last stage, after which the scene is complete


_TELLING = 5.0  # most seconds in which a page that follows learns of an error


class EndedError(Exception):
    """Nobody waits for the work any more."""


class Progress:
    """What is being done and how far it is. It is safe to share between threads."""

    def __init__(self):
        """Starts with nothing done."""
        self._changed = threading.Condition()
        self._stage: str = "starting"
        self._share: float | None = None
        self._way: _Way | None = None
        self._error: BaseException | None = None
        self._prepared = self._finished = self._asked = self._told = False

    def plan(self, stages: Sequence[tuple[str, float]]) -> None:
        """Sets what will be done, so that the page shows one share for the whole way. It never falls.

        Args:
            stages: The stages in their order, each with its part of the time. Some may be left out, and others come.
        """
        with self._changed:
            self._way = _Way(stages)

    def report(self, stage: str, share: float | None) -> None:
        """Sets what is being done, and which share of it is done, from 0 to 1; None if nobody knows.

        When all of it is done, what follows until the next report makes the scene from it.
        """
        with self._changed:
            done = share is not None and share >= 1
            self._stage, self._share = ("preparing the scene", None) if done else (stage, share)
            if self._way is not None:
                self._share = self._way.share(stage, share)

    def prepared(self) -> None:
        """The scene is complete. What follows makes it only faster."""
        self._set("_prepared", True)

    def fail(self, error: BaseException) -> None:
        """The scene cannot be computed."""
        self._set("_error", error)

    def finish(self) -> None:
        """Nothing more will be done."""
        self._set("_finished", True)

    def _set(self, name: str, value: object) -> None:
        with self._changed:
            setattr(self, name, value)
            self._changed.notify_all()

    def wait(self, *, patience: float = 0.0) -> None:
        """Waits until the scene is complete.

        Args:
            patience: If there is an error, most seconds to wait until a page was told of it; longer if one has asked.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._prepared or self._finished)
            if self._error is not None:
                self._changed.wait_for(lambda: self._told, _TELLING if self._asked else patience)
                raise self._error

    @property
    def finished(self) -> bool:
        """Whether nothing more will be done."""
        return self._finished

    def content(self) -> JsonObject:
        """The message to the page."""
        with self._changed:
            self._asked = True
            content = {"kind": "progress", "stage": self._stage, "fraction": self._share, "finished": self._finished}
            if self._error is None or not self._finished:
                return content
            self._told = True
            self._changed.notify_all()
            return content | {"error": str(self._error) or type(self._error).__name__}


class _Way:
    """The share of all stages that is done."""

    def __init__(self, stages: Sequence[tuple[str, float]]):
        self._left = list(stages)
        self._stage, self._within = "", 0.0
        self._done = self._first = self._last = 0.0

    def share(self, stage: str, share: float | None) -> float | None:
        """The share of the whole way, given that of a stage; None before anything is done."""
        if share is not None:
            if stage != self._stage or share < self._within:
                self._begin(stage)
            self._stage, self._within = stage, share
            self._done = max(self._done, self._first + (self._last - self._first) * share)
        return self._done or None

    def _begin(self, stage: str) -> None:
        self._first = self._last = self._done
        place = next((number for number, (name, _) in enumerate(self._left) if name == stage), None)
        # A stage that is reported anew, or again from its start, takes its planned part of what was left before it. One
        # that was not planned takes none, and the share waits.
        if place is not None:
            (_, part), *self._left = self._left[place:]
            self._last += (1 - self._done) * part / (part + sum(other for _, other in self._left))
