"""Goals on the arm: moving it, averaging a pose, the action's skeleton and client."""
