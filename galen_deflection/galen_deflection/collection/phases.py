"""What the states of a collection of pushes are called for a person."""

from galen_deflection.collection.commands import State

COLLECTION_PHASES = {
    State.CALIBRATION: "calibration set: keep off",
    State.MOVE: "moving: keep off",
    State.UNTOUCHED: "untouched: keep off",
    State.PUSH: "push",
    State.HOLD: "hold",
    State.RELEASE: "let go",
    State.REST: "keep off until the next push",
}
