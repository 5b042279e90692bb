"""A diagnosis in a sentence or two that a person understands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from galen_diagnosis.answer.answer import Answer, Cause
from galen_diagnosis.report.effect_words import cause_words, title

_MOST_PLACES = 3
_NAMED_SHARE = 0.1
_MOST_TWINS = 4
_SURE = 0.9
"""A cause as likely as this is there, whatever else is."""


def sentence(answer: Answer) -> str:
    """The verdict, what causes the gap with its numbers, how much of it that explains, where."""
    if answer.verdict == "none":
        return (
            "No gap: the recording is what the model says, but for noise and what a healthy arm"
            " may be off."
        )
    where = _where(answer.where)
    if answer.verdict == "unknown":
        best = _best_of_list(answer)
        left = _left(answer)
        return f"There is a gap that nothing on the list explains{best}.{left}{where}"
    if answer.verdict == "ambiguous":
        return _ambiguous(answer) + where
    return _identified(answer) + where


def _identified(answer: Answer) -> str:
    parts = [cause_words(cause) for cause in answer.causes]
    if len(parts) == 1:
        text = f"{_capital(parts[0])}: this explains{_closed(answer.gap)} of the gap."
    else:
        text = (
            f"{_capital('; '.join(parts[:-1]))}; and {parts[-1]}: together they explain"
            f"{_closed(answer.gap)} of the gap."
        )
    return text + "".join(_twins(cause) for cause in answer.causes)


def _ambiguous(answer: Answer) -> str:
    sure = [cause for cause in answer.causes if cause.probability >= _SURE]
    open_ = [cause for cause in answer.causes if cause.probability < _SURE]
    told = [cause_words(cause) for cause in sure]
    maybe = [_one_of(cause) for cause in open_]
    if told:
        text = f"{_capital('; and '.join(told))}."
        if maybe:
            text += (
                f" Whether there is more, this recording can't tell: perhaps {', or '.join(maybe)}."
            )
        text += "".join(_twins(cause) for cause in sure)
    elif maybe:
        text = "There is a gap, and this recording can't tell what causes it: "
        text += f"{', or '.join(maybe)}."
    else:
        return "There is a gap, and this recording can't tell what causes it."
    return f"{text} What is found explains{_closed(answer.gap)} of the gap."


def _one_of(cause: Cause) -> str:
    """An open cause with its probability and what can't be told from it."""
    text = f"{cause_words(cause)} ({cause.probability:.0%})"
    return f"{text}, or {_names(cause.equivalent)}" if cause.equivalent else text


def _twins(cause: Cause) -> str:
    if not cause.equivalent:
        return ""
    return f" This recording can't tell it from: {_names(cause.equivalent)}."


def _names(effects: Sequence[str]) -> str:
    """Some of them by name; of something faint it may be nearly all effects."""
    if len(effects) > _MOST_TWINS:
        return f"one of {len(effects)} other effects"
    return " or ".join(f"{title(name)} ({name})" for name in effects)


def _best_of_list(answer: Answer) -> str:
    known = [(name, p) for name, p in answer.ranking if name not in ("none", "unknown")]
    if not known or known[0][1] < 0.01:
        return ""
    name, probability = known[0]
    return f" (the nearest is {title(name)}, {probability:.0%})"


def _left(answer: Answer) -> str:
    if not answer.left_over:
        return ""
    return f" What the nearest leaves goes with: {answer.left_over[0]['what']}."


def _closed(gap: dict[str, Any]) -> str:
    closed = gap.get("closed_fraction")
    if not closed or closed.get("value") is None:
        return " an unknown part"
    text = f" {closed['value']:.0%}"
    interval = closed.get("ci95")
    return text + (f" ({interval[0]:.0%} to {interval[1]:.0%})" if interval else "")


def _where(where: dict[str, Any]) -> str:
    """The channels and bags that hold most of it."""
    phrases = []
    for name, preposition in (("channels", "in"), ("bags", "of")):
        shares = [(key, share) for key, share in where.get(name, {}).items() if share]
        shares = sorted(shares, key=lambda one: -one[1])[:_MOST_PLACES]
        shares = [one for one in shares if one[1] >= _NAMED_SHARE] or shares[:1]
        if shares:
            parts = " and ".join(f"{key} ({share:.0%})" for key, share in shares)
            phrases.append(f"{preposition} {parts}")
    if not phrases:
        return ""
    text = f" The gap lies {', '.join(phrases)}"
    follows = where.get("joints", {}).get("follows", [])
    if follows and follows[0]["p"] < 0.05 and follows[0]["part"] >= 0.3:
        text += f"; {follows[0]['part']:.0%} of it in the sweep follow {follows[0]['joint']}"
    return text + "."


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
