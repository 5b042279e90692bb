"""Goals on the arm: moving it, the action's skeleton and client."""
