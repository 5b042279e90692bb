"""What the states of a calibration and a quick check are called for a person."""

from galen_ros.goal.commands import State

from galen_calibration_behavior.quick_check import commands as check_commands

CALIBRATION_PHASES = {
    State.HOME: "going home",
    State.REMOVE_TOOL: "tool off",
    State.ZERO: "zeroing",
    State.SWEEP_BARE: "sweep without tool",
    State.ATTACH_TOOL: "tool on",
    State.SWEEP_TOOL: "sweep with tool",
    State.ESTIMATE: "estimating",
}
CHECK_PHASES = {
    check_commands.State.MEASURE: "checking",
    check_commands.State.RETURN: "going back",
}
