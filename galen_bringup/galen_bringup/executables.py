"""The executables; each imports its module when it starts."""

from galen_ros.executable import Executable

demo = Executable("galen_bringup.demo")
preflight = Executable("galen_bringup.preflight")
