"""What is wrong with a bag, as sentences."""

from __future__ import annotations

from collections.abc import Iterator

from galen_model.errors import one_line

_MOST = 20


class Problems:
    """Sentences, each once; a bag that is damaged all over doesn't fill the memory with them."""

    def __init__(self) -> None:
        """Start without any."""
        self._texts: list[str] = []
        self._more = False

    def add(self, text: str) -> None:
        """Note a problem. Reading a bag again finds the same ones again."""
        text = one_line(" ".join(text.split()))
        if text in self._texts:
            return
        if len(self._texts) < _MOST:
            self._texts.append(text)
        else:
            self._more = True

    def __iter__(self) -> Iterator[str]:
        """The sentences, in the order in which they were found."""
        yield from self._texts
        if self._more:
            yield f"there are more than these {_MOST} problems"
