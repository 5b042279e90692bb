# SPDX-License-Identifier: Apache-2.0
"""The words for each state that a node can tell: what it means, and what to do. No ROS.

`{tool}` is the active tool, `{node}` the node's name. A state that means different things at
different levels has the level after its name, as in `waiting stale`. A test goes through all
states that the nodes' code can tell.
"""

from __future__ import annotations

from typing import NamedTuple


class Advice(NamedTuple):
    """stopped: whether nothing goes out that should."""

    doing: str
    todo: str = ""
    stopped: bool = False


OUTPUT = {
    "gravcomp": ("It compensates", "No compensation"),
    "deflection": ("It predicts", "No prediction"),
}
"""What a node that works on wrenches does, and what lacks without it."""

NO_CLOCK = Advice(
    "Its time stands still: use_sim_time is set, but /clock has no publisher.",
    "Start the simulation, or play the recording with a clock. On a real arm start the node without"
    " use_sim_time.",
)

LIFECYCLE = {
    "unconfigured": Advice(
        "Switched off: it is not configured.",
        "Configure and activate it: ros2 lifecycle set /{node} configure, then activate.",
        True,
    ),
    "unconfigured failed": Advice(
        "It could not start.",
        "Fix what its message names, then: ros2 lifecycle set /{node} configure, then activate.",
        True,
    ),
    "inactive": Advice(
        "Paused: it is inactive.", "Activate it: ros2 lifecycle set /{node} activate", True
    ),
    "finalized": Advice("Shut down for good.", "End its process and start it again.", True),
}

REJECTED = {
    "wrong_frame": Advice(
        "the wrench is in another frame than the calibration file",
        "Set the driver's frame_id to the one that the message names, or calibrate the tool with"
        " this sensor.",
    ),
    "several_publishers": Advice(
        "two drivers publish the same topic",
        "Stop all but one of the nodes that the message names.",
    ),
    "frozen_wrench": Advice(
        "the sensor hangs, it reads the same while the arm turns",
        "Restart the sensor or its driver; look at its cable.",
    ),
    "unreadable": Advice(
        "messages can't be read", "Look for another program that publishes on this topic."
    ),
    "unstamped": Advice(
        "wrenches have no time stamp", "Make the driver stamp each wrench when it is sampled."
    ),
    "duplicate_stamp": Advice(
        "stamps are repeated",
        "Look whether two drivers run, or whether the driver sends a sample twice.",
    ),
    "nonfinite_wrench": Advice(
        "the wrench is not a number",
        "Restart the sensor's driver; look at the sensor's cable.",
    ),
    "no_joints": Advice(
        "there are no joint angles for it",
        "Start the arm's driver, or look whether it publishes joint_states.",
    ),
    "stale_joints": Advice(
        "the joint angles are too old",
        "Look whether the arm's driver still publishes joint_states, and whether both drivers stamp"
        " by the same clock.",
    ),
    "bad_joints": Advice(
        "the joints have other names",
        "Set the parameter joint_names to the names in joint_states.",
    ),
    "nonfinite_joints": Advice("joint angles are not numbers", "Restart the arm's driver."),
    "jumping_joints": Advice(
        "the joint angles jump",
        "Look whether two drivers publish joint_states, and whether the encoders work.",
    ),
    "implausible_units": Advice(
        "values look like those of another unit",
        "The driver must send torques in N·m and angles in rad. If the values are right, set the"
        " parameter check_units to false.",
    ),
    "wrong_setup": Advice(
        "readings at rest contradict the set-up",
        "Correct what the message names in the driver or the robot description; it goes on when a"
        " reading at rest fits.",
    ),
    "setup_not_verified": Advice(
        "no reading at rest has fitted yet",
        "Let the arm rest without contact; zero or tare the sensor if its offset has changed.",
    ),
    "queue_full": Advice(
        "wrenches come, but no joint angles that are as new",
        "Look whether the arm's driver still publishes joint_states, and whether both drivers stamp"
        " by the same clock.",
    ),
    "no_motion": Advice(
        "the inertial forces are not known",
        "Look at the IMU or the joints' rate, or switch it off: start gravcomp with motion:=off.",
    ),
    "out_of_order": Advice(
        "wrenches come in the wrong order", "Look whether two nodes publish the compensated wrench."
    ),
    "out_of_reach": Advice(
        "the joints are where the arm can't be",
        "Look whether joint_states are in metres and radians, and of this arm.",
    ),
    "nonfinite_prediction": Advice(
        "the prediction is not a number", "Load another model: set the parameter model_file."
    ),
    "disabled": Advice("the compensation is off", "Switch the compensation on."),
}
"""Reasons for which a wrench is not used; `doing` goes on after a colon."""

_SILENT = Advice(
    "No data: the driver is silent.",
    "Start the driver, or look at its cable and power. The message says which topic is missing.",
    True,
)
_WAITING = Advice(
    "It waits for the first wrenches with joint angles.",
    "Wait a moment. If it stays so, look whether the driver publishes wrench_raw and joint_states.",
    True,
)
_QOS = Advice(
    "Nothing comes in: the driver sends as best effort.",
    "Start this node with the parameter best_effort_input:=true",
    True,
)
_LATE = Advice(
    "It works, but its wrenches come late.",
    "Close other programs on this computer, and look at the network to the driver.",
)
_STREAM = {
    "silent": _SILENT,
    "several_publishers warn": Advice(
        "It works, but two nodes publish joint_states.",
        "Only one of them may have this arm's joints: stop the other one.",
    ),
    "waiting": _WAITING,
    "incompatible_qos": _QOS,
    "late": _LATE,
}

_NOTICED = "Read its message. If it comes again, look at the driver."

_GOAL_IDLE = {
    "ready": Advice("Ready."),
    "several_servers": Advice(
        "Takes no goal: another node serves the same action.",
        "End one of the two that its message names.",
        True,
    ),
    "failed": Advice(
        "Ready, but the last run failed.",
        "Read in its message why, fix it, and start again.",
    ),
}
_KEEP_OFF = "Keep off the arm and the tool."

FIT_NOT_JUDGED = Advice("Compensates '{tool}'; its fit is not judged during a calibration.")
"""In place of gravcomp's warning does_not_fit, which is expected while a calibration runs."""

ADVICE: dict[str, dict[str, Advice]] = {
    "gravcomp": _STREAM
    | {
        "bad_tool_file": Advice(
            "No compensation: the calibration file can't be used.",
            "Choose another tool, or calibrate this one again.",
            True,
        ),
        "disabled": Advice(
            "Compensation is off: nothing is published.",
            "Switch it on when the arm may follow the hand.",
            True,
        ),
        "no_tool": Advice("No compensation: no tool is chosen.", "Choose the tool.", True),
        "silent": _SILENT._replace(doing="No compensation: the driver is silent."),
        "waiting": _WAITING._replace(doing="No compensation yet: it waits for the first wrenches."),
        "incompatible_qos": _QOS._replace(
            doing="No compensation: the driver sends as best effort."
        ),
        "late": Advice(
            "Compensates '{tool}', but wrenches come late.",
            "Close other programs on this computer, and look at the network to the driver.",
        ),
        "compensating": Advice("Compensates '{tool}'."),
        "compensating warn": Advice("Compensates '{tool}', but noticed something.", _NOTICED),
        "taring": Advice("Tares '{tool}'.", "Keep off the tool and hold the arm still."),
        "tare_ramp": Advice(
            "Compensates '{tool}', the tare is coming in.", "Keep off the tool for a second."
        ),
        "does_not_fit": Advice(
            "Compensates '{tool}', but its file does not fit what is on the arm.",
            "Look whether the right tool is on and fastened; run the quick check, tare or calibrate"
            " again.",
        ),
        "bias_drift_limit": Advice(
            "Compensates '{tool}', but the sensor's zero has drifted too far.",
            "Tare without contact at the tool, or calibrate again.",
        ),
        "cable_outside": Advice(
            "Compensates '{tool}' without its cable's pull: the cable was not measured here.",
            "Move back to poses of the calibration, or measure the cable at these poses, too.",
        ),
        "file_changed": Advice(
            "Compensates '{tool}', but its file is another one now.",
            "Choose the tool again, to load the new calibration.",
        ),
    },
    "deflection": _STREAM
    | {
        "silent": Advice(
            "No prediction: no compensated wrench comes.",
            "Look at the compensation first: it is off, or the driver is silent.",
            True,
        ),
        "bad_model_file": Advice(
            "No prediction: the model's file can't be used.",
            "Set the parameter model_file to a good file, or train the model again.",
            True,
        ),
        "no_model": Advice(
            "No prediction: no model is loaded.",
            "Train one (ros2 run galen_deflection train) and set the parameter model_file.",
            True,
        ),
        "other_tip": Advice(
            "No prediction: the model is for another tool's tip.",
            "Choose the tool that the model was made with, or load this tool's model.",
            True,
        ),
        "predicting": Advice("Predicts the deflection."),
        "predicting warn": Advice("Predicts the deflection, but noticed something.", _NOTICED),
        "extrapolating": Advice(
            "Predicts beyond the loads or poses that the model has seen.",
            "Take such predictions with care, or collect pushes here and train again.",
        ),
        "start_unknown": Advice(
            "Predicts, but does not know the loads before its start.",
            "Push the arm once to both sides: then it does.",
        ),
    },
    "sim_driver": {
        "running": Advice("Runs."),
        "trajectory_rejected": Advice(
            "It rejected a motion.",
            "The message says why: mostly a pose out of the arm's limits, or too fast. Send it"
            " again, fixed.",
        ),
        "wrench_ignored": Advice(
            "It does not follow the hand: the wrench is not usable.",
            "The message says why. Look at the compensation.",
        ),
        "several_drivers": Advice(
            "Another node publishes joint_states, too.",
            "Stop one of the two drivers.",
        ),
        "slow": Advice(
            "Runs slower than real time.",
            "Close other programs on this computer, or ask for a lower speed_factor.",
        ),
    },
    "calibration": _GOAL_IDLE
    | {
        "HOME": Advice("Calibrates: the arm goes home.", _KEEP_OFF),
        "REMOVE_TOOL": Advice("Calibrates: it waits for you.", "Take the tool off, then confirm."),
        "ZERO": Advice("Calibrates: the sensor is zeroed.", _KEEP_OFF),
        "SWEEP_BARE": Advice("Calibrates: measures without the tool.", _KEEP_OFF),
        "ATTACH_TOOL": Advice("Calibrates: it waits for you.", "Put the tool on, then confirm."),
        "SWEEP_TOOL": Advice("Calibrates: measures with the tool.", _KEEP_OFF),
        "ESTIMATE": Advice("Calibrates: computes mass and centre."),
        "MEASURE": Advice("Checks: goes from pose to pose.", _KEEP_OFF),
        "RETURN": Advice("Checks: goes back to where it was.", _KEEP_OFF),
    },
    "collection": _GOAL_IDLE
    | {
        "CALIBRATION": Advice("Collects: measures the poses of a set.", _KEEP_OFF),
        "MOVE": Advice("Collects: the arm moves.", _KEEP_OFF),
        "UNTOUCHED": Advice("Collects: measures the arm untouched.", _KEEP_OFF),
        "PUSH": Advice("Collects: it waits for a push.", "Push as its message says."),
        "HOLD": Advice("Collects: the push is right.", "Hold it so."),
        "RELEASE": Advice("Collects: the push is done.", "Let go."),
        "REST": Advice("Collects: a pause before the next push.", _KEEP_OFF),
    },
}
