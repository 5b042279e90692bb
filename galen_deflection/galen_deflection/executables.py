"""The executables; each imports its module when it starts."""

from galen_common.executable import Executable

collect = Executable("galen_deflection.collection.command")
collection_node = Executable("galen_deflection.collection.node")
deflection_node = Executable("galen_deflection.node")
evaluate = Executable("galen_deflection.evaluate")
train = Executable("galen_deflection.train")
