"""The executables; each imports its module when it starts."""

from galen_ros.executable import Executable

diagnose = Executable("galen_diagnosis.diagnose")
blind_check = Executable("galen_diagnosis.blind_check")
